"""Stepping speed beside other ways to step: ``sb3-e2c stepping --env KeepAway-v0 --worlds 64``.

Random actions, resets and info dictionaries included, no learning. Ours steps all worlds in one
set of arrays; beside it the same worlds, one after the other, through SuperSuit, and for robots
what gymnasium and gymnasium-robotics offer (without walls, bombs and costs). They take turns, so
that a busy machine slows all of them.
"""

import argparse
import json
import statistics
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium
import numpy as np
import supersuit
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c import share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.vec_env import opponent_env
from sb3_e2c.zoo.configuration import check_env
from sb3_e2c.zoo.console import ConsoleParser, UserError, check_file, one_line_errors, write_whole
from sb3_e2c.zoo.speed import CLOCKS, add_output_flags

_FEW = 4  # worlds that are stepped one after the other: more of them are no faster
_ROBOTS = {"SafeAnt-2x4-v0": ("Ant", "2x4"), "SafeHalfCheetah-2x3-v0": ("HalfCheetah", "2x3")}


@dataclass
class Stepper:
    """One way to step, with what it has reached.

    :param name: What it is
    :param n_worlds: Worlds that ``step`` steps
    :param step: Steps all of them once
    """

    name: str
    n_worlds: int
    step: Callable[[], object]
    rates: list[float] = field(default_factory=list)  # world steps / s

    def take_turn(self, seconds: float, clock: Callable[[], float]) -> None:
        """Step for some time.

        :param seconds: At least so long
        :param clock: What a second is
        """
        steps, start = 0, clock()
        while (elapsed := clock() - start) < seconds or not steps:
            self.step()
            steps += self.n_worlds
        self.rates.append(steps / elapsed)


def _vectorised(name: str, env: VecEnv, n_worlds: int) -> Stepper:
    env.reset()
    actions = _random_actions(env.action_space, env.num_envs)
    return Stepper(name, n_worlds, lambda: env.step(next(actions)))


def _random_actions(space: gymnasium.Space, rows: int) -> Iterator[np.ndarray]:
    """Actions drawn in advance: drawing them is nobody's merit."""
    space.seed(0)
    drawn = [np.stack([space.sample() for _ in range(rows)]) for _ in range(100)]
    while True:
        yield from drawn


def _ours(env_id: str, n_worlds: int, backend: Literal["auto", "supersuit"]) -> Stepper:
    env = share_parameters(ENV_IDS[env_id], n_worlds, backend=backend)
    against = opponent_env(env)
    if against is not None:
        against.set_opponent("random")
    name = {"auto": "sb3-e2c", "supersuit": "sb3-e2c's reference through SuperSuit"}[backend]
    return _vectorised(f"{name}, {n_worlds} worlds", env, n_worlds)


def _robots_of_others(robot: str, factorization: str) -> Iterator[Stepper]:
    """The same robots without walls, bombs and costs."""
    from gymnasium_robotics import mamujoco_v1

    env = gymnasium.make(f"{robot}-v5")
    env.reset(seed=0)
    actions = _random_actions(env.action_space, 1)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions)[0])
        if terminated or truncated:
            env.reset()

    yield Stepper(f"gymnasium {robot}-v5, 1 world", 1, step)
    parallel = mamujoco_v1.parallel_env(robot, factorization, agent_obsk=1)
    parallel.render_mode = None
    vector = supersuit.pettingzoo_env_to_vec_env_v1(parallel)
    vector = supersuit.concat_vec_envs_v1(vector, 8, num_cpus=1, base_class="gymnasium")
    vector.reset()
    drawn = _random_actions(vector.action_space, vector.num_envs)
    yield Stepper(
        "gymnasium-robotics through SuperSuit, 8 worlds", 8, lambda: vector.step(next(drawn))
    )


def _steppers(env_id: str, n_worlds: int) -> Iterator[Stepper]:
    yield _ours(env_id, n_worlds, "auto")
    yield _ours(env_id, _FEW, "supersuit")
    if env_id in _ROBOTS:
        yield from _robots_of_others(*_ROBOTS[env_id])


def _check(args: argparse.Namespace) -> None:
    check_env(args.env)
    for name in ("worlds", "rounds", "seconds"):
        value = getattr(args, name)
        if not value > 0:
            raise UserError(f"--{name} is {value}; expected more than 0")
    check_file(args.json, "--json")


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Let all take turns.

    :param args: See :func:`make_parser`
    :return: Settings, and of each its world steps a second and ours' multiple of it, by turns
    """
    _check(args)
    steppers = list(_steppers(args.env, args.worlds))
    for _ in range(args.rounds + 1):
        for each in steppers:
            each.take_turn(args.seconds, CLOCKS[args.clock])
    rates = [each.rates[1:] for each in steppers]  # the first turn compiles
    return {
        "settings": {**vars(args), "json": None},
        "results": [
            {
                "name": stepper.name,
                "world_steps_per_second": statistics.median(theirs),
                "ratios": [mine / other for mine, other in zip(rates[0], theirs, strict=True)],
            }
            for stepper, theirs in zip(steppers, rates, strict=True)
        ],
    }


def table(outcome: dict[str, Any]) -> str:
    """The outcome for a person.

    :param outcome: See :func:`measure`
    """
    settings = outcome["settings"]
    clock = {"wall": "s", "cpu": "CPU second"}[settings["clock"]]
    lines = [f"{settings['env']}, world steps / {clock}, median of {settings['rounds']} turns"]
    for each in outcome["results"]:
        lines.append(f"{each['name']:<50}{each['world_steps_per_second']:>10,.0f}")
    for each in outcome["results"][1:]:
        ratios = each["ratios"]
        spread = f"({min(ratios):.1f} to {max(ratios):.1f})"
        lines.append(f"ratio to {each['name']}: {statistics.median(ratios):.1f} {spread}")
    return "\n".join(lines)


def make_parser() -> ConsoleParser:
    """The flags of ``stepping``."""
    parser = ConsoleParser(
        prog="sb3-e2c stepping",
        description=__doc__,
        examples=["sb3-e2c stepping --env PredatorPrey-v0 --worlds 64 --rounds 11"],
    )
    add = parser.add_argument
    add("--env", default="MultiRover-6-3-v0", help="environment id (default: MultiRover-6-3-v0)")
    add("--worlds", type=int, default=64, help="worlds of ours (default: 64)")
    add("--rounds", type=int, default=5, help="turns of each (default: 5)")
    add("--seconds", type=float, default=0.5, help="of a turn, at least (default: 0.5)")
    add_output_flags(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c stepping``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    np.random.seed(0)
    with one_line_errors(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of peers
        outcome = measure(args)
        if args.json is not None:
            write_whole(args.json, json.dumps(outcome, indent=2, default=str) + "\n")
        print(table(outcome))


if __name__ == "__main__":
    main()
