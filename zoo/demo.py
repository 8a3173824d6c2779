"""Train, evaluate and film one team: what ``make train`` runs.

E2C-MAPPO with a team constraint on MultiRover-6-3-v0: six rovers, three of which must meet at a
point of interest, and at most 20 collisions an episode.
"""

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_e2c import evaluate_team
from sb3_e2c.zoo import train
from sb3_e2c.zoo.build import build_model
from sb3_e2c.zoo.console import ConsoleParser, one_line_errors
from sb3_e2c.zoo.curves import plot_learning
from sb3_e2c.zoo.enjoy import summarize
from sb3_e2c.zoo.record import record_episode
from sb3_e2c.zoo.runs import EVALUATION_SEED, Run, load_model, make_env, open_run

ALGO, ENV_ID = "e2c_t", "MultiRover-6-3-v0"
EPISODES = WORLDS = 100


def make_parser() -> ConsoleParser:
    """The flags of the demo."""
    parser = ConsoleParser(
        prog="sb3-e2c demo",
        description=__doc__,
        examples=["sb3-e2c demo -n 500_000 --seed 1 -f logs"],
    )
    parser.add_argument("-n", "--n-timesteps", type=int, help="agent steps (default: the preset's)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")
    parser.add_argument("-f", "--log-folder", default="logs", help="log folder (default: logs)")
    return parser


def demo(args: argparse.Namespace) -> Path:
    """Train, print the table, and draw.

    :param args: See :func:`make_parser`
    :return: The folder of the run
    """
    flags = ["--algo", ALGO, "--env", ENV_ID, "--seed", str(args.seed), "-f", args.log_folder]
    flags += ["--verbose", "0", "--eval-freq", "-1", "-P"]
    flags += [] if args.n_timesteps is None else ["-n", str(args.n_timesteps)]
    run = open_run(train.train(flags), ALGO, ENV_ID)
    print(_table(_evaluate(run, args.seed, trained=False), _evaluate(run, args.seed, trained=True)))
    print(f"{_speed(run.folder):,.0f} agent steps per second")
    print(plot_learning(run.folder))
    with closing(make_env(run, 1, args.seed, {"render_mode": "rgb_array"})) as env:
        film = run.folder / "episode.gif"
        record_episode(load_model(run, env, args.seed), env, film, deterministic=False)
    print(film)
    return run.folder


def _evaluate(run: Run, seed: int, trained: bool) -> dict[str, Any]:
    """The team with its first or last weights, with sampled actions, on worlds of its own."""
    with closing(make_env(run, WORLDS, seed)) as env:
        make = load_model if trained else _first_model
        model = make(run, env, seed)
        env.seed(EVALUATION_SEED + seed)  # last: a model seeds its worlds with its own seed
        result = evaluate_team(model, env, EPISODES, deterministic=False)
    return summarize(run, model, result, deterministic=False, seed=seed)


def _first_model(run: Run, env: Any, seed: int) -> Any:
    """The model as it was before training: the same seed draws the same weights."""
    return build_model(run.algo, run.config, env, seed=seed)


def _speed(folder: Path) -> float:
    return float(pd.read_csv(folder / "progress.csv")["time/fps"].dropna().iloc[-1])


def _table(before: dict[str, Any], after: dict[str, Any]) -> str:
    rows = [("", "before", "after")]
    for name, key in (("mean reward", "team_return"), ("mean cost", "team_cost")):
        cells = [f"{s[key]:.2f} ± {s[f'{key}_se']:.2f}" for s in (before, after)]
        rows.append((name, cells[0], cells[1]))
    rows.append(("limit on it", "", f"{after['cost_limits'][0]:g}"))
    rows.append(("lambda", f"{before['lambda']:.3f}", f"{after['lambda']:.3f}"))
    title = f"{EPISODES} episodes of {ALGO} on {ENV_ID}, sampled actions, mean ± standard error"
    return "\n".join([title, *(f"{name:<12}{b:>16}{a:>16}" for name, b, a in rows)])


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c demo``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        demo(args)


if __name__ == "__main__":
    main()
