"""Training speed beside other libraries: ``python -m sb3_e2c.zoo.speed --policy gru``.

Every contender trains on the same task with the same network widths, epochs and minibatches; they
take turns, so that a busy machine slows all of them. One agent's step is a step. Ours trains a
central critic with one output for each agent, and a cost critic; the peers train neither.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import supersuit as ss
import torch as th
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c import MAPPO, share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.vec_env import opponent_env
from sb3_e2c.zoo.console import ConsoleParser, UserError, one_line_errors, unknown, write_whole

WIDTH = 128


@dataclass(frozen=True)
class Task:
    """What all contenders train on."""

    make_env: Callable[[], ParallelEnv]
    rollout: int  # steps of each world
    peers_env: Callable[[], ParallelEnv] | None = None  # the team alone; None: as make_env


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
    "simple_spread": Task(_simple_spread, rollout=200),
    "rover": Task(_rover, rollout=80),
    "predator_prey": Task(_hunt, rollout=200, peers_env=lambda: RandomOpponents(_hunt())),
}


class NoCost(BaseCallback):
    """Reports a cost of 0 where the task has none, so that ours can train its cost critic."""

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            info.setdefault("cost", 0.0)
        return True


@dataclass
class Contender:
    """One library, ready to train.

    :param name: For the table
    :param model: Its algorithm
    :param hooks: Share of the time to measure: name, object and method
    """

    name: str
    model: OnPolicyAlgorithm
    hooks: list[tuple[str, Any, str]]
    callback: BaseCallback | None = None
    rates: dict[int, list[float]] = field(default_factory=dict)  # steps / s by number of threads
    seconds: dict[str, float] = field(default_factory=dict)
    total: float = 0.0

    def __post_init__(self) -> None:
        for name, owner, method in self.hooks:
            setattr(owner, method, partial(self._timed, name, getattr(owner, method)))
        self.run_iteration()  # compiles, allocates
        self.seconds.clear()
        self.total = 0.0

    def _timed(self, name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + elapsed

    def run_iteration(self) -> float:
        """One rollout and one update; returns agent steps per second."""
        before, start = self.model.num_timesteps, time.perf_counter()
        self.model.learn(1, callback=self.callback, reset_num_timesteps=False, log_interval=10**9)
        elapsed = time.perf_counter() - start
        self.total += elapsed
        return (self.model.num_timesteps - before) / elapsed

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
            "name": self.name,
            "steps_per_second": statistics.median(self.best),
            "min": min(self.best),
            "max": max(self.best),
            "threads": threads,
            "runs": len(self.best),
            "shares": {**shares, "everything else": 1.0 - sum(shares.values())},
        }


def _supersuit(task: Task, n_worlds: int) -> VecEnv:
    """Slots as SuperSuit alone makes them, for the peers."""
    rows = ss.pettingzoo_env_to_vec_env_v1((task.peers_env or task.make_env)())
    return ss.concat_vec_envs_v1(rows, n_worlds, num_cpus=1, base_class="stable_baselines3")


def _settings(args: argparse.Namespace, task: Task, n_agents: int) -> dict[str, Any]:
    rows = task.rollout * args.worlds * n_agents
    return {
        "n_steps": task.rollout,
        "batch_size": rows // args.minibatches,
        "n_epochs": args.epochs,
        "device": "cpu",
    }


def _ours(args: argparse.Namespace, task: Task) -> Contender:
    env = share_parameters(task.make_env, n_worlds=args.worlds)
    against = opponent_env(env)
    if against is not None:
        against.set_opponent("random")
    model = MAPPO(
        "GruPolicy" if args.policy == "gru" else "MlpPolicy",
        env,
        cost_limits=10.0,
        policy_kwargs={"net_arch": [WIDTH, WIDTH] if args.policy == "mlp" else [WIDTH]},
        **_settings(args, task, env.n_agents),
    )
    hooks = [
        ("environment", model.env, "step"),
        ("inference", model.policy, "act"),
        ("values", model.rollout_buffer, "finish"),
        ("update", model, "train"),
    ]
    return Contender(f"sb3-e2c MAPPO ({args.policy})", model, hooks, NoCost())


def _peer(args: argparse.Namespace, task: Task) -> Contender:
    env = _supersuit(task, args.worlds)
    n_agents = env.num_envs // args.worlds
    settings = _settings(args, task, n_agents)
    model: OnPolicyAlgorithm
    if args.policy == "mlp":
        name = "SB3 PPO + SuperSuit"
        kwargs: dict[str, Any] = {"net_arch": [WIDTH, WIDTH]}
        model = PPO("MlpPolicy", env, policy_kwargs=kwargs, **settings)
    else:
        name = "sb3-contrib RecurrentPPO + SuperSuit"
        kwargs = {"net_arch": [WIDTH], "lstm_hidden_size": WIDTH}
        model = RecurrentPPO("MlpLstmPolicy", env, policy_kwargs=kwargs, **settings)
    hooks = [
        ("environment", model.env, "step"),
        ("inference", model.policy, "forward"),
        ("values", model.rollout_buffer, "compute_returns_and_advantage"),
        ("update", model, "train"),
    ]
    return Contender(name, model, hooks)


def benchmark(args: argparse.Namespace) -> dict[str, Any]:
    """Let the contenders take turns.

    :param args: See :func:`make_parser`
    :return: Settings, results and ratios, as ``--json`` writes them
    """
    if args.env not in TASKS:
        raise unknown("task (--env)", args.env, TASKS)
    for name in ("worlds", "epochs", "minibatches", "rounds"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name} is {getattr(args, name)}; expected at least 1")
    task = TASKS[args.env]
    contenders = [_ours(args, task), _peer(args, task)]
    for _ in range(args.rounds):
        for threads in args.threads:
            for contender in contenders:
                contender.measure(threads)
    results = [contender.report() for contender in contenders]
    ours = results[0]["steps_per_second"]
    return {
        "settings": {**vars(args), "json": None, "torch": th.__version__},
        "results": results,
        "ratios": {each["name"]: ours / each["steps_per_second"] for each in results[1:]},
    }


def table(outcome: dict[str, Any]) -> str:
    """The outcome for a person.

    :param outcome: See :func:`benchmark`
    """
    lines = [f"{'agent steps / s':<40}{'median':>9}{'min':>9}{'max':>9}  threads"]
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
    parser = ConsoleParser(prog="sb3-e2c speed", description=__doc__)
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
    add("--json", type=Path, metavar="FILE", help="write the results to FILE")
    return parser


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
