"""Training speed beside other libraries: ``python -m sb3_e2c.zoo.speed --policy gru``.

Every contender trains on the same task with the same network widths, epochs and minibatches; they
take turns, so that a busy machine slows all of them. One agent's step is a step. Ours trains a
central critic with one output for each agent, and a cost critic; SB3 and sb3-contrib neither.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.callbacks import BaseCallback

from sb3_e2c import MAPPO, share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.vec_env import MultiAgentVecEnv, opponent_env
from sb3_e2c.zoo.console import (
    ConsoleParser,
    UserError,
    check_file,
    one_line_errors,
    unknown,
    write_whole,
)
from sb3_e2c.zoo.peers import (
    INSTALLED,
    REPOSITORIES,
    WIDTH,
    Learner,
    Plan,
    is_installed,
    sb3,
    sb3_iteration,
)

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


@dataclass(frozen=True)
class Task:
    """What all contenders train on."""

    make_env: Callable[[], ParallelEnv]
    rollout: int  # steps of each world
    episode: int  # steps
    peers_env: Callable[[], ParallelEnv] | None = None  # the team alone; None: as make_env
    batched: bool = True  # whether ours steps all worlds in one set of arrays

    @property
    def team_env(self) -> Callable[[], ParallelEnv]:
        """Makes a world in which only the team acts."""
        return self.peers_env or self.make_env


class RandomOpponents(BaseParallelWrapper):
    """Hides the opponents from peers, who know no such thing; their actions are random."""

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.possible_agents = list(env.metadata["team"])
        self.opponents = list(env.metadata["opponents"])
        self.render_mode = None

    @property
    def agents(self) -> list[str]:
        """The team."""
        return self.possible_agents if self.env.agents else []

    @agents.setter
    def agents(self, _: list[str]) -> None:
        pass

    @property
    def unwrapped(self) -> ParallelEnv:
        """Not the wrapped environment: SuperSuit reads the agents there."""
        return self

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Step with a random action of every opponent."""
        others = {agent: self.env.action_space(agent).sample() for agent in self.opponents}
        answers = self.env.step({**actions, **others})
        observations, rewards, terminated, truncated, infos = (
            {agent: answer[agent] for agent in self.possible_agents} for answer in answers
        )
        return observations, rewards, terminated, truncated, infos


def _simple_spread() -> ParallelEnv:
    try:
        from mpe2 import simple_spread_v3
    except ImportError as error:
        raise UserError(
            "simple_spread needs the particle environments: pip install mpe2"
        ) from error
    return simple_spread_v3.parallel_env(N=3, max_cycles=25)


def _rover() -> ParallelEnv:
    return ENV_IDS["MultiRover-6-2-v0"](reward_at="capture")


def _hunt() -> ParallelEnv:
    return ENV_IDS["PredatorPrey-v0"](max_cycles=25)


TASKS = {
    "simple_spread": Task(_simple_spread, rollout=200, episode=25, batched=False),
    "rover": Task(_rover, rollout=80, episode=80),
    "predator_prey": Task(
        _hunt, rollout=200, episode=25, peers_env=lambda: RandomOpponents(_hunt())
    ),
}


class NoCost(BaseCallback):
    """Reports a cost of 0 where the task has none, so that ours can train its cost critic."""

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            info.setdefault("cost", 0.0)
        return True


@dataclass
class Contender:
    """A library that takes its turns.

    :param learner: The library
    :param clock: What a second is
    """

    learner: Learner
    clock: Callable[[], float]
    rates: dict[int, list[float]] = field(default_factory=dict)  # steps / s by number of threads
    seconds: dict[str, float] = field(default_factory=dict)
    total: float = 0.0

    def __post_init__(self) -> None:
        for name, owner, method in self.learner.hooks:
            setattr(owner, method, partial(self._timed, name, getattr(owner, method)))
        self.run_iteration()  # compiles, allocates
        self.seconds.clear()
        self.total = 0.0

    def _timed(self, name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        start = self.clock()
        try:
            return function(*args, **kwargs)
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self.clock() - start

    def run_iteration(self) -> float:
        """One rollout and one update; returns agent steps per second."""
        start = self.clock()
        steps = self.learner.iterate()
        elapsed = self.clock() - start
        self.total += elapsed
        return steps / elapsed

    def measure(self, threads: int) -> None:
        """Run one iteration with a number of torch threads."""
        th.set_num_threads(threads)
        self.rates.setdefault(threads, []).append(self.run_iteration())

    @property
    def best(self) -> list[float]:
        """Rates with the number of threads that suits it best."""
        return max(self.rates.values(), key=statistics.median)

    def report(self) -> dict[str, Any]:
        """Median, spread and shares."""
        shares = {name: spent / self.total for name, spent in self.seconds.items()}
        threads = max(self.rates, key=lambda n: statistics.median(self.rates[n]))
        return {
            "name": self.learner.name,
            "steps_per_second": statistics.median(self.best),
            "min": min(self.best),
            "max": max(self.best),
            "threads": threads,
            "runs": len(self.best),
            "shares": {**shares, "everything else": 1.0 - sum(shares.values())},
        }


def _plan(args: argparse.Namespace, task: Task) -> Plan:
    return Plan(
        make_env=task.team_env,
        episode=task.episode,
        policy=args.policy,
        rollout=task.rollout,
        n_worlds=args.worlds,
        n_epochs=args.epochs,
        n_minibatches=args.minibatches,
        n_agents=len(task.team_env().possible_agents),
    )


def _our_worlds(task: Task, plan: Plan, same_environment: bool) -> MultiAgentVecEnv:
    if same_environment:
        return share_parameters(plan.make_env, plan.n_worlds, backend="supersuit")
    env = share_parameters(task.make_env, plan.n_worlds)
    against = opponent_env(env)
    if against is not None:
        against.set_opponent("random")
    return env


def _ours(task: Task, plan: Plan, same_environment: bool) -> Learner:
    model = MAPPO(
        "GruPolicy" if plan.recurrent else "MlpPolicy",
        _our_worlds(task, plan, same_environment),
        cost_limits=10.0,
        policy_kwargs={"net_arch": [WIDTH] if plan.recurrent else [WIDTH, WIDTH]},
        **plan.sb3_settings(),
    )
    hooks = [
        ("environment", model.env, "step"),
        ("inference", model.policy, "act"),
        ("values", model.rollout_buffer, "finish"),
        ("update", model, "train"),
    ]
    return Learner(f"sb3-e2c MAPPO ({plan.policy})", sb3_iteration(model, NoCost()), hooks)


def _peers(names: Sequence[str], plan: Plan) -> Iterator[Learner]:
    """The peers of every run, and those that were asked for.

    :param names: What ``--peer`` was given
    :param plan: What they train
    """
    yield sb3(plan)
    asked = dict.fromkeys(names)
    if is_installed("benchmarl") and not plan.recurrent:
        asked.setdefault("benchmarl")
    for each in asked:
        name, _, path = each.partition("=")
        if name in INSTALLED and not path:
            yield INSTALLED[name](plan)
        elif name in REPOSITORIES and path:
            yield REPOSITORIES[name](plan, Path(path).expanduser().resolve())
        elif name in REPOSITORIES:
            raise UserError(f"--peer {name} needs its repository: --peer {name}=PATH")
        else:
            raise unknown("peer (--peer)", each, [*INSTALLED, *REPOSITORIES])


def _check(args: argparse.Namespace) -> None:
    if args.env not in TASKS:
        raise unknown("task (--env)", args.env, TASKS)
    for name in ("worlds", "epochs", "minibatches", "rounds"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name} is {getattr(args, name)}; expected at least 1")
    if min(args.threads) < 1:
        raise UserError(f"--threads is {min(args.threads)}; expected at least 1")
    if args.clock == "cpu" and args.threads != [1]:
        raise UserError("--clock cpu adds up what all threads use; expected --threads 1 with it")
    check_file(args.json, "--json")


def benchmark(args: argparse.Namespace) -> dict[str, Any]:
    """Let the contenders take turns.

    :param args: See :func:`make_parser`
    :return: Settings, results and ratios, as ``--json`` writes them
    """
    _check(args)
    task = TASKS[args.env]
    plan, same = _plan(args, task), args.same_environment or not task.batched
    learners = [_ours(task, plan, same), *_peers(args.peer, plan)]
    contenders = [Contender(learner, CLOCKS[args.clock]) for learner in learners]
    for _ in range(args.rounds):
        for threads in args.threads:
            for contender in contenders:
                contender.measure(threads)
    results = [contender.report() for contender in contenders]
    ours = results[0]["steps_per_second"]
    return {
        "settings": {**vars(args), "json": None, "torch": th.__version__},
        "same_environment": same,
        "results": results,
        "ratios": {each["name"]: ours / each["steps_per_second"] for each in results[1:]},
    }


def table(outcome: dict[str, Any]) -> str:
    """The outcome for a person.

    :param outcome: See :func:`benchmark`
    """
    sides = "ours all worlds in one set of arrays, the peers one world after the other"
    if outcome["same_environment"]:
        sides = "the same on all sides, one world after the other"
    clock = {"wall": "s", "cpu": "CPU second"}[outcome["settings"]["clock"]]
    lines = [
        f"environment: {outcome['settings']['env']}, {sides}",
        f"{f'agent steps / {clock}':<40}{'median':>9}{'min':>9}{'max':>9}  threads",
    ]
    for each in outcome["results"]:
        numbers = "".join(f"{each[key]:>9,.0f}" for key in ("steps_per_second", "min", "max"))
        lines.append(f"{each['name']:<40}{numbers}{each['threads']:>9}")
    for name, ratio in outcome["ratios"].items():
        lines.append(f"ratio to {name}: {ratio:.1f}")
    for each in outcome["results"]:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in each["shares"].items())
        lines.append(f"{each['name']}: {shares}")
    return "\n".join(lines)


def make_parser() -> ConsoleParser:
    """The flags of the benchmark."""
    parser = ConsoleParser(
        prog="sb3-e2c speed",
        description=__doc__,
        examples=["sb3-e2c speed --policy gru --worlds 8 --threads 1 2 --json speed.json"],
    )
    add = parser.add_argument
    add("--env", default="simple_spread", help=f"{', '.join(TASKS)} (default: simple_spread)")
    add("--policy", choices=("mlp", "gru"), default="mlp", help="networks (default: mlp)")
    add("--worlds", type=int, default=8, help="copies of the environment (default: 8)")
    add("--epochs", type=int, default=10, help="epochs of an update (default: 10)")
    add("--minibatches", type=int, default=4, help="minibatches of an epoch (default: 4)")
    add("--rounds", type=int, default=5, help="turns of each contender (default: 5)")
    add(
        "--threads",
        type=int,
        nargs="+",
        default=[1, 2],
        help="torch threads to try; each contender is judged by its best (default: 1 2)",
    )
    add(
        "--same-environment",
        action="store_true",
        help="ours, too, steps one world after the other through SuperSuit",
    )
    add(
        "--peer",
        action="append",
        default=[],
        metavar="NAME[=PATH]",
        help="one more library, besides SB3 and sb3-contrib; may be repeated. "
        f"{', '.join(INSTALLED)} (if installed, always), or with the path of a checkout: "
        f"{', '.join(REPOSITORIES)}",
    )
    add_output_flags(parser)
    return parser


def add_output_flags(parser: ConsoleParser) -> None:
    """What seconds are, and where the results go.

    :param parser: Of a benchmark
    """
    parser.add_argument(
        "--clock",
        choices=tuple(CLOCKS),
        default="wall",
        help="cpu: seconds that the processor worked for us, all threads together, for a busy "
        "machine (default: wall)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results to FILE")


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c speed``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    np.random.seed(0)
    th.manual_seed(0)
    with one_line_errors():
        outcome = benchmark(args)
        if args.json is not None:
            write_whole(args.json, json.dumps(outcome, indent=2, default=str) + "\n")
        print(table(outcome))


if __name__ == "__main__":
    main()
