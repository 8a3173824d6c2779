"""Play every team of a benchmark against adversaries that it was not trained beside.

Return against an adversary that learned together with the team says little about the team. Here
all teams of a task meet the same opponents: random actions, and the adversaries of some method's
runs (without that of the team's own run). Call it again to go on, when new runs have finished, or
with another pool, which is added to the table.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from tqdm.auto import tqdm

from sb3_e2c.opponents import adversary_path
from sb3_e2c.zoo import enjoy
from sb3_e2c.zoo.benchmark import parse_seeds
from sb3_e2c.zoo.console import ConsoleParser, UserError, one_line_errors, unknown, write_whole
from sb3_e2c.zoo.results import CROSSPLAY, Place, evaluation_numbers, read_json, read_table
from sb3_e2c.zoo.suite import Suite, find_suite, read_suite

_SEED = 2_000_000  # worlds in which nobody has trained or been evaluated
_WHO = ["env", "label", "seed", "opponent"]
_WHICH = [*_WHO, "trained", "opponent_trained", "episodes"]


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


class Opponent(NamedTuple):
    """Somebody to play against.

    :param word: What ``enjoy --opponent`` calls it
    :param trained: When its run finished; empty if it is no other run's
    """

    word: str
    trained: str = ""


def opponents(place: Place, pool: Sequence[Place]) -> dict[str, Opponent]:
    """A team's opponents by name.

    :param place: The team's job
    :param pool: Jobs whose adversaries play
    """
    others = [each for each in pool if each.job.env == place.job.env and each != place]
    named = {
        f"{p.job.method.label}/seed_{p.job.seed}": Opponent(str(adversary(p)), _finished(p))
        for p in others
    }
    return {"own": Opponent("own"), "random": Opponent("random")} | named


def _finished(place: Place) -> str:
    return str(read_json(place.done)["finished"])


def play(place: Place, against: dict[str, Opponent], n_episodes: int) -> Iterator[dict[str, Any]]:
    """Rows of the table for one team.

    :param place: Its job
    :param against: See :func:`opponents`
    :param n_episodes: Against each
    """
    job, trained = place.job, _finished(place)
    flags = ["--algo", job.method.algo, "--env", job.env, "-f", str(place.log_folder)]
    flags += ["--n-episodes", str(n_episodes), "--n-envs", str(min(n_episodes, 64))]
    flags += ["--seed", str(_SEED + 100 * job.seed), "--verbose", "0"]
    flags += ["--opponent", *(each.word for each in against.values())]
    result = enjoy.enjoy(enjoy.make_parser().parse_args(flags))
    for (name, opponent), each in zip(against.items(), result["against"], strict=True):
        who = dict(zip(_WHO, (job.env, job.method.label, job.seed, name), strict=True))
        when = {"trained": trained, "opponent_trained": opponent.trained}
        yield who | when | {"episodes": each["episodes"]} | evaluation_numbers(each)


def _is_of(table: pd.DataFrame, place: Place) -> "pd.Series[bool]":
    job = place.job
    mine = (table["env"] == job.env) & (table["label"] == job.method.label)
    return mine & (table["seed"] == job.seed)


def _up_to_date(
    table: pd.DataFrame, place: Place, known: dict[str, Opponent], n_episodes: int
) -> pd.DataFrame:
    """A team's rows that need not be played again: as many episodes, of the same two runs."""
    rows = table[_is_of(table, place)]
    trained = [getattr(known.get(name), "trained", None) for name in rows["opponent"]]
    good = (rows["episodes"] == n_episodes) & (rows["trained"] == _finished(place))
    return rows[good & (rows["opponent_trained"] == pd.Series(trained, rows.index, dtype=object))]


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
    table = pd.DataFrame(columns=_WHICH)
    if path.is_file():
        table = read_table(path, keep_default_na=False, na_values={"lambda": ""})
        # An older version did not say who met: all is played anew
        numbers = [name for name in table if name not in _WHICH]
        table = table.reindex(columns=[*_WHICH, *numbers], fill_value="")
    for place in tqdm(found):
        against = opponents(place, pool)
        kept = _up_to_date(table, place, opponents(place, found), args.n_episodes)
        missing = {
            name: each for name, each in against.items() if name not in set(kept["opponent"])
        }
        if missing:
            rows = pd.DataFrame(play(place, missing, args.n_episodes))
            others = table[~_is_of(table, place)]
            table = pd.concat([each for each in (others, kept, rows) if len(each)])
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
