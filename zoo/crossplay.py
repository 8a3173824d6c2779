"""Play every team of a benchmark against adversaries that it was not trained beside.

Return against an adversary that learned together with the team says little about the team. Here
all teams of a task meet the same opponents: random actions, and the adversaries of some method's
runs (without that of the team's own run). Call it again to go on, or when new runs have finished.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm.auto import tqdm

from sb3_e2c.opponents import adversary_path
from sb3_e2c.zoo import enjoy
from sb3_e2c.zoo.benchmark import parse_seeds
from sb3_e2c.zoo.console import ConsoleParser, UserError, one_line_errors, unknown, write_whole
from sb3_e2c.zoo.results import CROSSPLAY, Place, evaluation_numbers, read_table
from sb3_e2c.zoo.suite import Suite, find_suite, read_suite

_SEED = 2_000_000  # worlds in which nobody has trained or been evaluated
_WHO = ["env", "label", "seed", "opponent"]


def make_parser() -> ConsoleParser:
    """The flags of ``crossplay``."""
    parser = ConsoleParser(
        prog="sb3-e2c crossplay",
        description=__doc__,
        examples=["sb3-e2c crossplay --suite paper -f benchmark --pool mappo --pool-seeds 0-2"],
    )
    add = parser.add_argument
    add("--suite", required=True, help="as for benchmark")
    add("-f", "--folder", type=Path, default=Path("benchmark"), help="folder of the benchmark")
    add("--pool", default="mappo", metavar="METHOD", help="whose adversaries (default: mappo)")
    add("--pool-seeds", nargs="+", default=["0-2"], metavar="SEED", help="of them (default: 0-2)")
    add("--n-episodes", type=int, default=128, help="against each opponent (default: 128)")
    return parser


def teams(folder: Path, suite: Suite) -> list[Place]:
    """Finished runs beside which an adversary was saved.

    :param folder: The benchmark's folder
    :param suite: Its suite
    """
    places = [Place(folder, job) for job in suite.jobs()]
    return [place for place in places if place.done.exists() and adversary(place).is_file()]


def adversary(place: Place) -> Path:
    """Where the adversary of a run lies, if it has one.

    :param place: The run's job
    """
    return adversary_path((place.run or place.work) / f"{place.job.env}.zip")


def opponents(place: Place, pool: Sequence[Place]) -> dict[str, str]:
    """Names of a team's opponents, and what ``enjoy --opponent`` calls them.

    :param place: The team's job
    :param pool: Jobs whose adversaries play
    """
    others = [each for each in pool if each.job.env == place.job.env and each != place]
    named = {f"{p.job.method.label}/seed_{p.job.seed}": str(adversary(p)) for p in others}
    return {"own": "own", "random": "random"} | named


def play(place: Place, against: dict[str, str], n_episodes: int) -> Iterator[dict[str, Any]]:
    """Rows of the table for one team.

    :param place: Its job
    :param against: See :func:`opponents`
    :param n_episodes: Against each
    """
    job = place.job
    flags = ["--algo", job.method.algo, "--env", job.env, "-f", str(place.log_folder)]
    flags += [
        "--n-episodes",
        str(n_episodes),
        "--n-envs",
        str(min(n_episodes, 64)),
        "--verbose",
        "0",
    ]
    flags += ["--seed", str(_SEED + 100 * job.seed), "--opponent", *against.values()]
    result = enjoy.enjoy(enjoy.make_parser().parse_args(flags))
    for name, each in zip(against, result["against"], strict=True):
        who = dict(zip(_WHO, (job.env, job.method.label, job.seed, name), strict=True))
        yield who | {"episodes": each["episodes"]} | evaluation_numbers(each)


def _missing(done: pd.DataFrame, place: Place, against: dict[str, str]) -> dict[str, str]:
    """Those opponents that a team has not met yet."""
    job = place.job
    mine = (done["env"] == job.env) & (done["label"] == job.method.label)
    met = set(done[mine & (done["seed"] == job.seed)]["opponent"])
    return {name: word for name, word in against.items() if name not in met}


def crossplay(args: argparse.Namespace) -> Path:
    """Play.

    :param args: See :func:`make_parser`
    :return: The table
    :raises UserError: if there is nobody to play
    """
    if args.n_episodes < 1:
        raise UserError(f"--n-episodes is {args.n_episodes}; expected at least 1")
    suite = read_suite(find_suite(args.suite))
    if args.pool not in suite.methods:
        raise unknown("method (--pool)", args.pool, suite.methods)
    found, seeds = teams(args.folder, suite), parse_seeds(args.pool_seeds) or []
    pool = [p for p in found if p.job.method.label == args.pool and p.job.seed in seeds]
    if not pool:
        raise UserError(
            f"{args.folder} has no finished runs of {args.pool} with an adversary and one of these "
            "seeds; run the benchmark first, or choose others with --pool and --pool-seeds"
        )
    path = args.folder / "results" / suite.name / CROSSPLAY
    table = read_table(path) if path.is_file() else pd.DataFrame(columns=_WHO)
    for place in tqdm(found):
        against = _missing(table, place, opponents(place, pool))
        if against:
            rows = pd.DataFrame(play(place, against, args.n_episodes))
            table = rows if table.empty else pd.concat([table, rows], ignore_index=True)
            write_whole(path, table.to_csv(index=False, float_format="%.6g"))
    return path


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c crossplay``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        print(crossplay(args))


if __name__ == "__main__":
    main()
