"""Run the experiments of a suite: ``sb3-e2c benchmark --suite paper -f FOLDER --jobs 4``.

Each method, environment and seed is a job of its own. Call it again, with the same flags, to go on
after an interruption; several calls, also from several machines, may share a folder. The small
files under FOLDER/results are what sb3-e2c plot draws, also while the benchmark runs.
"""

import argparse
import re
import shlex
import signal
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from sb3_e2c.descent import n_cores
from sb3_e2c.zoo import jobs
from sb3_e2c.zoo.configuration import team_limits
from sb3_e2c.zoo.console import (
    ConsoleParser,
    UserError,
    check_writable,
    one_line_errors,
    write_whole,
)
from sb3_e2c.zoo.jobs import BUSY, Outcome
from sb3_e2c.zoo.pools import LocalPool, Pool, RayPool
from sb3_e2c.zoo.results import Place, advice, read_json
from sb3_e2c.zoo.suite import Job, check_methods, find_suite, read_suite, suite_names, suite_text

_MOST_SEEDS = 10_000  # of a range: more is a slip of the hand
_LOOK_EVERY = 1.0  # seconds
_PRINT_EVERY = 60.0  # seconds between lines where lines cannot be overwritten


def make_parser() -> ConsoleParser:
    """The flags of ``benchmark``."""
    parser = ConsoleParser(
        prog="sb3-e2c benchmark",
        description=__doc__,
        examples=[
            "sb3-e2c benchmark --suite smoke -f benchmark --jobs 2",
            "sb3-e2c benchmark --suite paper -f benchmark --ray local --seeds 0-4",
        ],
    )
    add = parser.add_argument
    names = ", ".join(suite_names())
    add("--suite", required=True, help=f"{names}, or a YAML file of your own")
    add("-f", "--folder", type=Path, default=Path("benchmark"), help="folder (default: benchmark)")
    add("-j", "--jobs", type=int, help="jobs at a time (default: as many as there are cores)")
    add("--ray", metavar="ADDRESS", help="run on a Ray cluster (local: start one here)")
    add("--seeds", nargs="+", metavar="SEED", help="other seeds than the suite's: 0 3 5-9")
    add("--only", nargs="+", metavar="GLOB", default=[], help="EXPERIMENT/ENV/METHOD/seed_SEED")
    add("--dry-run", action="store_true", help="list what there is to do, and do nothing")
    return parser


def parse_seeds(words: Sequence[str] | None) -> list[int] | None:
    """Seeds, and ranges of them.

    :param words: For instance 0 3 5-9; None for none given
    :raises UserError: for anything else
    """
    if words is None:
        return None
    seeds: dict[int, None] = {}
    for word in words:
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", word)
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise UserError(f"--seeds: found {word!r}, expected numbers such as 0 3 5-9")
        first, last = int(match[1]), int(match[2] or match[1])
        if last >= 2**32 or last - first >= _MOST_SEEDS:
            raise UserError(
                f"--seeds: found {word!r}, expected numbers below 2**32, and at most "
                f"{_MOST_SEEDS:,} of them"
            )
        seeds.update(dict.fromkeys(range(first, last + 1)))
    return list(seeds)


@dataclass
class Progress:
    """What has been done, and how long the rest will take.

    :param lengths: Agent steps of each job
    """

    lengths: dict[Place, int]
    done: set[Place] = field(default_factory=set)
    failed: list[Outcome] = field(default_factory=list)
    running: dict[Place, int] = field(default_factory=dict)
    elsewhere: int = 0

    def __post_init__(self) -> None:
        self.done = {place for place in self.lengths if place.done.exists()}
        self._started = time.monotonic()
        self._known = {place: self._steps(place) for place in self.lengths}
        self._at_first = sum(self._known.values())

    def _steps(self, place: Place) -> int:
        return self.lengths[place] if place in self.done else place.steps()

    def look(self, running: Sequence[Place], waiting: Sequence[Place]) -> None:
        """Read how far the jobs are.

        :param running: Jobs of this process
        :param waiting: Jobs that this process has not started
        """
        self.done |= {place for place in waiting if place.done.exists()}
        self.running = {place: self._steps(place) for place in running}
        self._known |= self.running | {place: self.lengths[place] for place in self.done}

    @property
    def rate(self) -> float:
        """Agent steps per second since the start, all jobs together."""
        elapsed = max(time.monotonic() - self._started, 1e-9)
        return max(sum(self._known.values()) - self._at_first, 0) / elapsed

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the end at this rate; None before the first steps."""
        given_up = {outcome.place for outcome in self.failed}
        left = [self.lengths[p] - self._known[p] for p in self.lengths if p not in given_up]
        return max(sum(left), 0) / self.rate if self.rate else None

    def line(self) -> str:
        """All of it in one line."""
        left = self.seconds_left
        parts = [
            f"{len(self.done)}/{len(self.lengths)} jobs done",
            f"{len(self.running)} running",
            f"{self.elsewhere} run by others" if self.elsewhere else "",
            f"{len(self.failed)} failed" if self.failed else "",
            f"{self.rate:,.0f} agent steps/s",
            "" if left is None else f"{timedelta(seconds=round(left))} left",
        ]
        return ", ".join(part for part in parts if part)

    def lines(self) -> str:
        """The line, and one for each running job."""
        shares = [f"  {p.job.name}  {n / self.lengths[p]:.0%}" for p, n in self.running.items()]
        return "\n".join([self.line(), *shares])


@contextmanager
def _display() -> Iterator[tuple[Callable[[str], None], Callable[[Progress], None]]]:
    """How to print a line, and how to show progress: in place on a terminal, else now and then."""
    console = Console(soft_wrap=True, highlight=False)
    if console.is_terminal:
        with Live(console=console, auto_refresh=False) as live:

            def redraw(progress: Progress) -> None:
                live.update(Text(progress.lines()), refresh=True)

            yield lambda line: console.print(Text(line)), redraw
        return
    last = time.monotonic()

    def now_and_then(progress: Progress) -> None:
        nonlocal last
        if time.monotonic() - last > _PRINT_EVERY:
            last = time.monotonic()
            print(progress.line(), flush=True)

    yield lambda line: print(line, flush=True), now_and_then


def work(places: Sequence[Place], progress: Progress, pool: Pool) -> None:
    """Run jobs until none is left that this process could run or wait for.

    :param places: The jobs
    :param progress: Kept up to date
    :param pool: Where they run
    """
    waiting = deque(places)
    with _display() as (tell, show):
        while waiting or pool.running():
            _start_what_can_be(waiting, progress, pool)
            for outcome in pool.collect():
                _note(outcome, waiting, progress, tell)
            progress.look(pool.running(), waiting)
            show(progress)
            if waiting or pool.running():
                time.sleep(_LOOK_EVERY)


def _start_what_can_be(waiting: deque[Place], progress: Progress, pool: Pool) -> None:
    """Start jobs, passing over those that others have done or are working on."""
    progress.elsewhere = 0
    for _ in range(len(waiting)):
        if not pool.has_room():
            return
        place = waiting.popleft()
        if place.done.exists():
            progress.done.add(place)
        elif jobs.is_busy(place):
            progress.elsewhere += 1
            waiting.append(place)
        else:
            pool.start(place)


def _note(
    outcome: Outcome, waiting: deque[Place], progress: Progress, tell: Callable[[str], None]
) -> None:
    place = outcome.place
    if outcome.status == BUSY:
        waiting.append(place)
    elif outcome.failed:
        progress.failed.append(outcome)
        tell(f"failed {place.job.name}: {outcome.message}")
    else:
        progress.done.add(place)
        tell(f"done   {place.job.name}: {_result(place)}")


def _result(place: Place) -> str:
    result = read_json(place.results / "evaluation.json")["sampled"]
    text = f"return {result['team_return']:.3f}"
    if result["team_cost"] is None:
        return text
    limits = ", ".join(f"{limit:g}" for limit in result["cost_limits"]) or "none"
    return f"{text}, cost {_number(result['team_cost'])} (limit {limits})"


def _number(value: Any) -> str:
    return ", ".join(f"{v:.2f}" for v in value) if isinstance(value, list) else f"{value:.2f}"


def check_settings(place: Place, config: dict[str, Any]) -> None:
    """Refuse to count a finished job with other settings as this one, or one that is damaged.

    :param place: Where the job lies
    :param config: Its settings now
    :raises UserError: naming what has changed
    """
    with advice(place.results):
        then = read_json(place.done).get("config", {})
        read_json(place.results / "evaluation.json")
    changed = sorted(key for key in then if then[key] != config.get(key))
    if changed:
        key = changed[0]
        raise UserError(
            f"{place.results} was trained with other settings ({key}: {then[key]!r}, now "
            f"{config.get(key)!r}); remove it to train again, or choose another folder (-f)"
        )


def plan(places: Sequence[Place]) -> tuple[dict[Place, int], list[Outcome]]:
    """Which jobs can run, and how long they are.

    :param places: The jobs
    :return: Agent steps of those that can, and those that the zoo refuses
    :raises UserError: for finished jobs with other settings
    """
    lengths: dict[Place, int] = {}
    refused: list[Outcome] = []
    known: dict[tuple[str, str], dict[str, Any] | UserError] = {}
    for place in places:
        key = (place.job.env, place.job.method.label)
        if key not in known:
            known[key] = _configuration(place.job)
        config = known[key]
        if isinstance(config, UserError):
            refused.append(Outcome(place, 2, str(config)))
            continue
        if place.done.exists():
            check_settings(place, config)
        lengths[place] = config["n_timesteps"]
    return lengths, refused


def _configuration(job: Job) -> dict[str, Any] | UserError:
    try:
        return job.configuration()
    except UserError as error:
        return error


def describe(lengths: dict[Place, int], refused: Sequence[Outcome]) -> list[str]:
    """What ``--dry-run`` prints: a line for each method on each environment.

    :param lengths: Agent steps of the jobs
    :param refused: Jobs that the zoo refuses
    """
    groups: dict[tuple[str, str], list[Place]] = defaultdict(list)
    for place in lengths:
        groups[place.job.env, place.job.method.label].append(place)
    lines = []
    for (env, label), places in groups.items():
        done = sum(place.done.exists() for place in places)
        limits = team_limits(env, places[0].job.configuration())
        seeds = ", ".join(str(place.job.seed) for place in places)
        lines.append(
            f"{env} {label}: seeds {seeds}; {lengths[places[0]]:,} agent steps; "
            f"limit {', '.join(f'{limit:g}' for limit in limits) or 'none'}; {done} done"
        )
    lines += [f"cannot run: {line}" for line in _by_message(refused)]
    return [*lines, f"{sum(not p.done.exists() for p in lengths)} of {len(lengths)} jobs to do"]


def _by_message(failures: Sequence[Outcome]) -> list[str]:
    """Failures, those for one reason together."""
    groups: dict[str, list[str]] = defaultdict(list)
    for outcome in failures:
        groups[outcome.message].append(outcome.place.job.name)
    return [
        f"{names[0]}{f' and {len(names) - 1} more' if names[1:] else ''}: {message}"
        for message, names in groups.items()
    ]


def _check(args: argparse.Namespace) -> None:
    if args.jobs is not None and args.jobs < 1:
        raise UserError(f"--jobs is {args.jobs}; expected at least 1")
    check_writable(args.folder, "--folder")


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def benchmark(args: argparse.Namespace) -> list[Outcome]:
    """Run a suite.

    :param args: See :func:`make_parser`
    :return: The jobs that failed
    :raises UserError: for what cannot be meant
    :raises KeyboardInterrupt: after Ctrl-C or SIGTERM, when all jobs have stopped
    """
    _check(args)
    path = find_suite(args.suite)
    suite = read_suite(path)
    check_methods(path, suite)
    chosen = suite.jobs(parse_seeds(args.seeds), args.only)
    lengths, refused = plan([Place(args.folder, job) for job in chosen])
    if args.dry_run:
        print("\n".join(describe(lengths, refused)))
        return []
    write_whole(args.folder / "results" / suite.name / "suite.yml", suite_text(path))
    for outcome in refused:
        jobs.record_failure(outcome.place, outcome.status, [outcome.message])
    for line in _by_message(refused):  # now, not only after hours
        print(f"cannot run: {line}", file=sys.stderr, flush=True)
    progress = Progress(lengths, failed=list(refused))
    with _sigterm_as_ctrl_c(), closing(_make_pool(args)) as pool:
        print(progress.line(), flush=True)
        work([place for place in lengths if place not in progress.done], progress, pool)
    print(progress.line())
    return progress.failed


def _make_pool(args: argparse.Namespace) -> Pool:
    if args.ray is None:
        return LocalPool(args.jobs or n_cores())
    return RayPool(args.ray, args.jobs)


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c benchmark``.

    :param argv: Flags; default: those of this process
    """
    flags = list(sys.argv[1:] if argv is None else argv)
    args = make_parser().parse_args(flags)
    with one_line_errors():
        try:
            failed = benchmark(args)
        except KeyboardInterrupt:
            again = shlex.join(["sb3-e2c", "benchmark", *flags])
            print(f"stopped; what has been finished is kept. Go on with: {again}", file=sys.stderr)
            raise SystemExit(130) from None
    if failed:
        print(f"{len(failed)} jobs failed:", *_by_message(failed), sep="\n  ", file=sys.stderr)
        print("calling the same again tries them again", file=sys.stderr)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
