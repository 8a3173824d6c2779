"""Draw what has been learned: the curves of one run, or the figures and tables of a benchmark.

A benchmark's figures are drawn from the small files under its results folder alone.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from sb3_e2c.zoo.console import (
    ConsoleParser,
    UserError,
    check_writable,
    one_line_errors,
    unknown,
    write_whole,
)
from sb3_e2c.zoo.curves import plot_learning
from sb3_e2c.zoo.figures import Look, draw_curves, draw_finals
from sb3_e2c.zoo.report import (
    Groups,
    comparison_table,
    how_to_read,
    html_figure,
    html_page,
    html_table,
    html_text,
    markdown_table,
    png,
    readable_comparisons,
    readable_crossplay,
    readable_summary,
    summary_table,
)
from sb3_e2c.zoo.results import CROSSPLAY, MODES, Result, final_numbers, find_results, read_table
from sb3_e2c.zoo.suite import Experiment, Suite, read_suite


def make_parser() -> ConsoleParser:
    """The flags of ``plot``."""
    parser = ConsoleParser(
        prog="sb3-e2c plot",
        description=__doc__,
        examples=[
            "sb3-e2c plot logs/e2c_t/MultiRover-6-3-v0_1  # curves of one run, into its folder",
            "sb3-e2c plot -f benchmark  # every suite in benchmark/results",
            "sb3-e2c plot -f results --suite paper -o figures  # one suite, from committed results",
        ],
    )
    add = parser.add_argument
    add("run", nargs="?", type=Path, help="folder of one run of train")
    add("-f", "--folder", type=Path, help="folder of a benchmark, or its results folder")
    add("--suite", help="which of its suites (default: all)")
    add(
        "-o",
        "--out",
        type=Path,
        help="picture of the run (default: learning.png there), or folder for the benchmark's "
        "figures (default: plots beside its results)",
    )
    return parser


@dataclass(frozen=True)
class Data:
    """A suite with what its jobs have left.

    :param suite: The suite
    :param results: See :func:`find_results`
    :param crossplay: See ``sb3_e2c.zoo.crossplay``; None if nobody has played
    """

    suite: Suite
    results: Sequence[Result]
    crossplay: pd.DataFrame | None = None

    def groups(self) -> Groups:
        """Results by environment and label."""
        groups: dict[tuple[str, str], list[Result]] = defaultdict(list)
        for result in self.results:
            groups[result.env, result.label].append(result)
        return groups


def suite_folders(folder: Path, name: str | None) -> list[Path]:
    """Folders of the suites of a benchmark.

    :param folder: The benchmark's, or the results folder in it
    :param name: Of one suite; None for all
    :raises UserError: if there are none
    """
    inner = folder / "results"
    base = inner if inner.is_dir() else folder
    found = {path.parent.name: path.parent for path in sorted(base.glob("*/suite.yml"))}
    if not found:
        raise UserError(f"{folder} has no results: found no SUITE/suite.yml in {base}")
    if name is not None and name not in found:
        raise unknown(f"suite (--suite) in {base}", name, found)
    return list(found.values()) if name is None else [found[name]]


def plot_suite(folder: Path, out: Path) -> Path:
    """Write pictures, tables and the report of a suite.

    :param folder: The suite's folder with the small files
    :param out: Folder to write into
    :return: The report
    """
    suite = read_suite(folder / "suite.yml", folder.name)
    crossplay = read_table(folder / CROSSPLAY) if (folder / CROSSPLAY).is_file() else None
    data = Data(suite, _of_suite(suite, find_results(folder)), crossplay)
    finals = final_numbers(data.results)
    summary = summary_table(finals, data.groups())
    comparisons = [comparison_table(each, finals) for each in suite.experiments]
    write_whole(out / "runs.csv", finals.to_csv(index=False, float_format="%.6g"))
    write_whole(out / "summary.csv", summary.to_csv(index=False, float_format="%.6g"))
    tests = pd.concat(comparisons, ignore_index=True)
    write_whole(out / "comparisons.csv", tests.to_csv(index=False, float_format="%.4g"))
    page, text = _head(data), [f"# {suite.title}\n", *_status(data)]
    for experiment, tests in zip(suite.experiments, comparisons, strict=True):
        pictures = _pictures(experiment, data, finals, out)
        if not pictures:
            continue
        print(f"{folder.name}: {experiment.id}", file=sys.stderr)
        heading = f"{experiment.figure}: {experiment.title}"
        page += [html_text("h2", heading), *pictures]
        text += [f"\n## {heading}"]
        for title, table in _tables(experiment, data, summary, tests):
            page += [html_text("h3", title), html_table(table)]
            text += [f"\n### {title}\n", markdown_table(table)]
    notes = how_to_read([len(runs) for _, runs in finals.groupby(["env", "label", "mode"])])
    page += [html_text("h2", "How to read this"), *(html_text("p", note) for note in notes)]
    text += ["\n## How to read this", *(f"\n{note}" for note in notes)]
    write_whole(out / "tables.md", "\n".join(text) + "\n")
    write_whole(out / "report.html", html_page(suite.title, page))
    return out / "report.html"


def _of_suite(suite: Suite, results: Sequence[Result]) -> list[Result]:
    """Without methods that the suite does not have any more."""
    return [result for result in results if result.label in suite.methods]


def _status(data: Data) -> list[str]:
    """How much of the suite has been run, with what."""
    wanted = len(data.suite.jobs())
    done = [result for result in data.results if result.finished]
    failed = sum(result.failed for result in data.results)
    lines = [f"{len(done)} finished runs of {wanted} in the suite, {failed} failed."]
    if done:
        hours = sum(each.record.get("training_seconds", 0.0) for each in done) / 3600
        cpus = sorted({str(each.record["machine"]["cpu"]) for each in done})
        versions = sorted({f"{n} {v}" for each in done for n, v in each.record["versions"].items()})
        lines.append(f"Training took {hours:.2f} hours in all, on {', '.join(cpus)}.")
        lines.append(f"Versions: {', '.join(versions)}.")
    return lines


def _head(data: Data) -> list[str]:
    return [html_text("p", line, "note") for line in _status(data)]


def _pictures(experiment: Experiment, data: Data, finals: pd.DataFrame, out: Path) -> list[str]:
    """Write the pictures of an experiment; returns them as HTML."""
    look = Look(data.suite.methods)
    figures = {
        "curves": draw_curves(experiment, data.groups(), look),
        "finals": draw_finals(experiment, finals[finals["mode"] == "sampled"], look),
    }
    pictures = []
    for kind, figure in figures.items():
        if figure is not None:
            write_whole(out / f"{experiment.id}_{kind}.png", png(figure))
            pictures.append(html_figure(figure, f"{experiment.figure}, {kind}: {experiment.title}"))
    return pictures


def _tables(
    experiment: Experiment, data: Data, summary: pd.DataFrame, comparisons: pd.DataFrame
) -> list[tuple[str, pd.DataFrame]]:
    if summary.empty:
        return []
    tables = [
        (f"After training, {mode} actions", readable_summary(experiment, summary, data.suite, mode))
        for mode in MODES
    ]
    if not comparisons.empty:
        title = "Against the baselines, sampled actions"
        tables.append((title, readable_comparisons(comparisons, data.suite)))
    if data.crossplay is not None:
        table = readable_crossplay(experiment, data.crossplay, data.suite)
        if not table.empty:
            title = "Against the own adversary, random actions, and adversaries of other runs"
            tables.append((title, table))
    return tables


def plot(args: argparse.Namespace) -> list[Path]:
    """Draw.

    :param args: See :func:`make_parser`
    :return: What to look at
    :raises UserError: if there is nothing to draw
    """
    if (args.run is None) == (args.folder is None):
        raise UserError("plot needs the folder of one run, or -f with the folder of a benchmark")
    if args.run is not None:
        if args.suite is not None:
            raise UserError("--suite goes with -f, not with the folder of one run")
        return [plot_learning(args.run, args.out)]
    folders = suite_folders(args.folder, args.suite)
    out = args.out or folders[0].parent.parent / "plots"
    check_writable(out, "--out")
    return [plot_suite(folder, out / folder.name) for folder in folders]


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c plot``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        print(*plot(args), sep="\n")


if __name__ == "__main__":
    main()
