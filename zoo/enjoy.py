"""Evaluate a trained team: ``python -m sb3_e2c.zoo.enjoy --algo e2c_t --env MultiRover-6-3-v0``.

The model is rebuilt from the run's config.yml, and only its weights are read from the zip file, so
that a downloaded file cannot execute anything (unless you --trust it).
"""

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm

from sb3_e2c import MAPPO, evaluate_team
from sb3_e2c.evaluation import TeamEvaluation, standard_error
from sb3_e2c.vec_env import opponent_env
from sb3_e2c.zoo.configuration import team_limits
from sb3_e2c.zoo.console import (
    ConsoleParser,
    StoreDict,
    UserError,
    check_device,
    check_file,
    one_line_errors,
    write_whole,
)
from sb3_e2c.zoo.record import check_video, record_episode
from sb3_e2c.zoo.runs import (
    Run,
    add_run_flags,
    add_seed_flag,
    check_seed,
    choose_opponent,
    find_run,
    load_model,
    make_env,
)


def make_parser() -> ConsoleParser:
    """The flags of ``enjoy``: RL-Zoo's names, and ``--n-episodes --json --video --trust``."""
    parser = ConsoleParser(
        prog="sb3-e2c enjoy",
        description=(__doc__ or "").split("\n\n")[1],
        examples=[
            "sb3-e2c enjoy --algo e2c_t --env MultiRover-6-3-v0 -f logs --video team.gif",
            "sb3-e2c enjoy --algo e2c_t --env PredatorPrey-v0 --opponent own random --json a.json",
        ],
    )
    add, switch = parser.add_argument, "store_true"
    add_run_flags(parser)
    add("--n-episodes", type=int, default=100, help="episodes of the team (default: 100)")
    add("--n-envs", type=int, default=10, help="worlds at a time (default: 10)")
    how = parser.add_mutually_exclusive_group().add_argument
    how("--deterministic", action=switch, help="take the most likely actions")
    how(
        "--stochastic",
        action=switch,
        help="sample actions (the default: the limits were trained for the sampled policy)",
    )
    add(
        "--opponent",
        nargs="+",
        default=["own"],
        metavar="own|random|FILE",
        help="who plays against the team, where somebody does: the adversary that was trained "
        "beside it (default), random actions, or saved adversaries; several are reported in turn",
    )
    add(
        "--deterministic-opponent",
        action=switch,
        help="the adversary takes its most likely actions (default: it samples)",
    )
    add_seed_flag(parser)
    add("--env-kwargs", nargs="+", action=StoreDict, metavar="KEY:VALUE", help="changed arguments")
    add("--device", default="auto", help="torch device (default: auto)")
    add(
        "--no-render",
        action=switch,
        help="accepted as RL-Zoo's flag: there is never a window; see --video",
    )
    add(
        "--json",
        type=Path,
        metavar="FILE",
        help="write the results to FILE; cost_limits is a list, other numbers of a constraint are "
        "lists only if there are several constraints",
    )
    add("--video", type=Path, metavar="FILE", help="film one episode (.gif or .mp4)")
    add("--trust", action=switch, help="unpickle the model: it can then execute code")
    add("-P", "--progress", action=switch, help="progress bar")
    add("--verbose", type=int, default=1, help="0: print nothing")
    return parser


def _check(args: argparse.Namespace) -> None:
    for name in ("n_episodes", "n_envs"):
        if getattr(args, name) < 1:
            flag = f"--{name.replace('_', '-')}"
            raise UserError(f"{flag} is {getattr(args, name)}; expected at least 1")
    check_seed(args.seed)
    check_device(args.device)
    check_file(args.json, "--json")
    check_video(args.video, "--video")


def summarize(run: Run, model: MAPPO, result: TeamEvaluation, **settings: Any) -> dict[str, Any]:
    """What ``--json`` writes: means over episodes with their standard errors (``_se``).

    ``team_cost``, its error and ``lambda`` are numbers with one constraint, lists with several and
    None without any; ``cost_limits`` is always a list.

    :param run: The run
    :param model: Its model
    :param result: Its evaluation, E episodes
    :param settings: Further entries
    """
    limits = team_limits(run.env_id, run.config)
    costs = result.costs
    return {
        "algo": run.algo,
        "env": run.env_id,
        "model": str(run.model_path),
        "preset": run.flags.get("preset"),
        "episodes": len(result.returns),
        **settings,
        "team_return": float(result.returns.mean()),
        "team_return_se": float(standard_error(result.returns)),
        "team_cost": _plain(costs.mean(axis=0)),
        "team_cost_se": _plain(standard_error(costs)),
        "cost_limits": limits,
        "constrained": bool(len(model.cost_limits)),
        "violation_rate": result.violation_rate(limits) if limits and costs.size else None,
        "episode_length": float(result.lengths.mean()),
        "lambda": _plain(model.multipliers.state_dict()["values"].mean(dim=0).tolist()),
    }


def _plain(numbers: Any) -> Any:
    """A float for one number, a list for several, None for none."""
    values = [float(number) for number in numbers]
    return values[0] if len(values) == 1 else values or None


def report(summary: dict[str, Any]) -> str:
    """The summary for a person.

    :param summary: See :func:`enjoy`
    """
    against = summary.get("against", [])
    if len(against) > 1:
        return "\n".join([_heading(summary), _table(against)])
    lines = [_heading(summary)]
    if against:
        lines.append(f"opponent   {summary['opponent']}")
    return "\n".join([*lines, *_results(summary)])


def _heading(summary: dict[str, Any]) -> str:
    actions = "most likely actions" if summary["deterministic"] else "sampled actions"
    episodes = f"{summary['episodes']} episodes of the team, {actions}, seed {summary['seed']}"
    preset = f" (--preset {summary['preset']})" if summary["preset"] else ""
    return f"{summary['model']}{preset}\n{episodes}"


def _table(summaries: list[dict[str, Any]]) -> str:
    """One line for each opponent."""
    rows = [("opponent", "return", "cost", "violation")]
    for each in summaries:
        cost, rate = each["team_cost"], each["violation_rate"]
        rows.append(
            (
                str(each["opponent"]),
                _mean(each["team_return"], each["team_return_se"]),
                "-" if cost is None else _mean(cost, each["team_cost_se"]),
                "-" if rate is None else f"{rate:.1%}",
            )
        )
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _results(summary: dict[str, Any]) -> list[str]:
    lines = [f"return     {_mean(summary['team_return'], summary['team_return_se'])}"]
    if summary["team_cost"] is not None:
        limits = ", ".join(f"{limit:g}" for limit in summary["cost_limits"])
        imposed = "limit" if summary["constrained"] else "not constrained; the task's limit"
        lines.append(
            f"cost       {_mean(summary['team_cost'], summary['team_cost_se'])}  "
            f"({imposed} {limits or 'unknown'})"
        )
    if summary["violation_rate"] is not None:
        lines.append(f"violation  {summary['violation_rate']:.1%} of the episodes over the limit")
    if summary["lambda"] is not None:
        numbers = ", ".join(f"{number:.3f}" for number in np.atleast_1d(summary["lambda"]))
        lines.append(f"lambda     {numbers}")
    return lines


def _mean(mean: Any, error: Any) -> str:
    pairs = zip(np.atleast_1d(mean), np.atleast_1d(error), strict=True)
    return ", ".join(f"{m:.3f} ± {e:.3f}" for m, e in pairs)


def enjoy(args: argparse.Namespace) -> dict[str, Any]:
    """Evaluate, write and print what came of it, and film, as asked.

    :param args: See :func:`make_parser`
    :return: See :func:`summarize`; with opponents also ``opponent``, and what came of each one that
        was asked for in the list ``against``
    """
    _check(args)
    run = find_run(args)
    with closing(make_env(run, args.n_envs, args.seed, args.env_kwargs, args.trust)) as env:
        model = load_model(run, env, args.seed, args.device, args.trust, args.opponent[0])
        has_opponents = opponent_env(env) is not None
        summaries = []
        for opponent in args.opponent:
            choose_opponent(run, model, env, opponent, args.deterministic_opponent)
            result = _evaluate(model, env, args)
            who = {"opponent": opponent} if has_opponents else {}
            settings = {"deterministic": args.deterministic, "seed": args.seed, **who}
            summaries.append(summarize(run, model, result, **settings))
    summary = {**summaries[0], "against": summaries} if has_opponents else summaries[0]
    if args.json is not None:
        write_whole(args.json, json.dumps(summary, indent=2) + "\n")
    if args.verbose > 0:
        print(report(summary), flush=True)
    if args.video is not None:  # last: a film may take minutes
        _film(run, model, args)
    return summary


def _evaluate(model: MAPPO, env: VecEnv, args: argparse.Namespace) -> TeamEvaluation:
    set_random_seed(args.seed)
    env.seed(args.seed)
    with closing(tqdm(total=args.n_episodes, disable=not args.progress)) as bar:
        return evaluate_team(
            model,
            env,
            args.n_episodes,
            args.deterministic,
            callback=lambda locals_, _: bar.update(int(locals_["done"])),
        )


def _film(run: Run, model: MAPPO, args: argparse.Namespace) -> None:
    kwargs = {**(args.env_kwargs or {}), "render_mode": "rgb_array"}
    if args.verbose > 0:
        print(
            f"Filming one episode to {args.video}; 2000 steps take minutes (-P: count)", flush=True
        )
    with closing(make_env(run, 1, args.seed, kwargs, args.trust)) as env:
        choose_opponent(run, model, env, args.opponent[0], args.deterministic_opponent)
        record_episode(model, env, args.video, args.deterministic, args.progress)


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c enjoy``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        enjoy(args)


if __name__ == "__main__":
    main()
