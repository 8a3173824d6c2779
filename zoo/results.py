"""The small files that a benchmark leaves: a curve, two evaluations, and how they came about.

They are all that ``plot`` needs, and small enough to be committed::

    FOLDER/results/SUITE/suite.yml
    FOLDER/results/SUITE/ENV/METHOD/seed_SEED/curve.csv        a row for each window of episodes
    FOLDER/results/SUITE/ENV/METHOD/seed_SEED/evaluation.json  what enjoy --json writes
    FOLDER/results/SUITE/ENV/METHOD/seed_SEED/run.json         settings, versions; written last
    FOLDER/results/SUITE/ENV/METHOD/seed_SEED/failure.json     instead, if the job failed
    FOLDER/results/SUITE/crossplay.csv                         what crossplay adds
    FOLDER/runs/SUITE/ENV/METHOD/seed_SEED/                    logs and models, as train writes them
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_e2c.monitor import named_costs
from sb3_e2c.zoo.console import UserError, write_whole
from sb3_e2c.zoo.suite import Job

MODES = ("sampled", "deterministic")
CROSSPLAY = "crossplay.csv"


@dataclass(frozen=True)
class Place:
    """Where the files of a job are.

    :param folder: The benchmark's folder
    :param job: The job
    """

    folder: Path
    job: Job

    @property
    def results(self) -> Path:
        """Folder of the small files."""
        return self.folder / "results" / self.job.suite / self.job.name

    @property
    def work(self) -> Path:
        """Folder of logs and models."""
        return self.folder / "runs" / self.job.suite / self.job.name

    @property
    def done(self) -> Path:
        """The file that stands for a finished job."""
        return self.results / "run.json"

    @property
    def failure(self) -> Path:
        """The file that stands for a failed job."""
        return self.results / "failure.json"

    @property
    def log(self) -> Path:
        """What the job has printed."""
        return self.work / "log.txt"

    @property
    def lock(self) -> Path:
        """The file that one process at a time holds."""
        return self.work / "lock"

    @property
    def log_folder(self) -> Path:
        """The ``-f`` of ``train`` and ``enjoy``."""
        return self.work / "logs"

    @property
    def run(self) -> Path | None:
        """Folder of the run, once training has begun; the newest if there are several."""
        found = (self.log_folder / self.job.method.algo).glob(f"{self.job.env}_*")
        numbered = [path for path in found if path.name.rpartition("_")[2].isdigit()]
        return max(numbered, key=lambda path: int(path.name.rpartition("_")[2]), default=None)

    def steps(self) -> int:
        """Agent steps that the run has logged so far."""
        try:
            progress = pd.read_csv((self.run or self.work) / "progress.csv")
            return int(progress["time/total_timesteps"].max())
        except (OSError, ValueError, KeyError):  # not begun, or just being written
            return 0


def read_table(path: Path, **options: Any) -> pd.DataFrame:
    """Read a CSV file with at least one row.

    :param path: The file
    :param options: For ``pandas.read_csv``
    :raises UserError: if there is none, or no row in it
    """
    try:
        table = pd.read_csv(path, **options)
    except (OSError, ValueError) as error:  # EmptyDataError is a ValueError
        raise UserError(f"cannot read {path}: {error}") from None
    if table.empty:
        raise UserError(f"{path} has no rows; has the run finished an episode?")
    return table


def agent_steps(episodes: pd.DataFrame, progress: pd.DataFrame) -> np.ndarray:
    """Agent steps at the end of each episode, all worlds running side by side.

    :param episodes: monitor.csv, E rows
    :param progress: progress.csv
    :return: Shape (E,)
    """
    counters = progress[["time/total_timesteps", "time/env_steps"]].dropna()
    first, steps = counters.iloc[0], episodes["l"].cumsum().to_numpy()
    n_agents = round(first["time/total_timesteps"] / first["time/env_steps"])
    before = counters["time/total_timesteps"].iloc[-1] - n_agents * steps[-1]  # a continued run
    return n_agents * steps + max(before, 0)


def learning_curve(
    episodes: pd.DataFrame, progress: pd.DataFrame, limits: Sequence[float], window: int
) -> pd.DataFrame:
    """Means over each ``window`` finished episodes; the last row may have fewer.

    :param episodes: monitor.csv
    :param progress: progress.csv
    :param limits: Of the team's costs, shape (M,)
    :param window: Episodes of a row
    :return: ``episodes`` and ``agent_steps`` so far, ``seconds`` since the start of the worlds,
        means of ``reward`` and ``cost`` (``cost_0``, ... if there are several), the ``limit`` of
        each cost, ``violation`` (share of episodes over any limit), ``lambda`` as last logged
    """
    costs = [name for name in episodes.columns if name.startswith("cost")]
    rows = np.arange(len(episodes)) // window
    table = pd.DataFrame({"agent_steps": agent_steps(episodes, progress), "seconds": episodes["t"]})
    table = table.groupby(rows).last()
    means = episodes.groupby(rows)[["r", *costs]].mean()
    table.insert(0, "episodes", episodes.groupby(rows).size().cumsum())
    table[["reward", *costs]] = means
    if costs and len(limits) == len(costs):
        table[[name.replace("cost", "limit") for name in costs]] = list(limits)
        over = (episodes[costs].to_numpy() > np.asarray(limits)).any(axis=1)
        table["violation"] = pd.Series(over, dtype=float).groupby(rows).mean()
    return _with_multipliers(table, progress)


def _with_multipliers(table: pd.DataFrame, progress: pd.DataFrame) -> pd.DataFrame:
    for name in sorted(name for name in progress.columns if name.startswith("train/lambda")):
        logged = progress[["time/total_timesteps", name]].dropna()
        at = np.searchsorted(logged["time/total_timesteps"], table["agent_steps"], side="right") - 1
        values = np.where(at >= 0, logged[name].to_numpy()[at.clip(0)], np.nan)
        table[name.removeprefix("train/")] = values
    return table


def write_curve(place: Place, limits: Sequence[float]) -> None:
    """Write curve.csv from what the run has logged so far.

    :param place: Where
    :param limits: Of the team's costs, shape (M,)
    :raises UserError: if it has not logged anything yet
    """
    run = place.run or place.work
    progress = read_table(run / "progress.csv")
    episodes = read_table(run / "monitor.csv", comment="#").dropna()  # a row may be half written
    curve = learning_curve(episodes, progress, limits, place.job.window)
    write_whole(place.results / "curve.csv", curve.to_csv(index=False, float_format="%.6g"))


def write_json(path: Path, content: Any) -> None:
    """Write a file whole.

    :param path: Where
    :param content: Plain data
    """
    write_whole(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read plain data.

    :param path: The file
    :raises UserError: if there is no such file, or something else in it
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {error}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path} holds {type(content).__name__}, expected a JSON object")
    return content


@contextmanager
def advice(folder: Path) -> Iterator[None]:
    """Say what to do about a damaged file of a job.

    :param folder: Of the job's small files
    """
    try:
        yield
    except UserError as error:
        raise UserError(f"{error}; remove {folder} and run the benchmark again") from None


@dataclass(frozen=True)
class Result:
    """What a job has left.

    :param folder: Folder of its small files
    :param env: Its environment
    :param label: Its method
    :param seed: Its seed
    """

    folder: Path
    env: str
    label: str
    seed: int

    @cached_property
    def curve(self) -> pd.DataFrame | None:
        """Its learning curve so far; None if no episode has finished."""
        path = self.folder / "curve.csv"
        with advice(self.folder):
            return read_table(path) if path.is_file() else None

    @cached_property
    def evaluation(self) -> dict[str, Any] | None:
        """Its evaluations by mode; None if it has not finished."""
        with advice(self.folder):
            return read_json(self.folder / "evaluation.json") if self.finished else None

    @cached_property
    def record(self) -> dict[str, Any]:
        """How it came about; empty if it has not finished."""
        with advice(self.folder):
            return read_json(self.folder / "run.json") if self.finished else {}

    @cached_property
    def failed(self) -> bool:
        """Whether it ended with an error when it was last tried."""
        return not self.finished and (self.folder / "failure.json").is_file()

    @cached_property
    def finished(self) -> bool:
        """Whether it has been trained and evaluated."""
        return (self.folder / "run.json").is_file()


def find_results(folder: Path) -> list[Result]:
    """All that jobs of a suite have left.

    :param folder: The suite's folder
    """
    found = sorted(folder.glob("*/*/seed_*"), key=lambda path: (path.parent, len(path.name), path))
    return [
        Result(path, path.parent.parent.name, path.parent.name, int(path.name[5:]))
        for path in found
        if path.name[5:].isdigit()
    ]


def final_numbers(results: Sequence[Result]) -> pd.DataFrame:
    """The evaluations of finished runs, a row for each run and mode.

    :param results: See :func:`find_results`
    :return: ``env, label, seed, mode``, ``return``, ``cost`` and ``limit`` (``cost_0``, ... if
        there are several), ``violation`` and ``lambda`` (mean over constraints), NaN for none
    """
    rows = [
        {"env": result.env, "label": result.label, "seed": result.seed, "mode": mode}
        | evaluation_numbers(result.evaluation[mode])
        for result in results
        if result.evaluation is not None
        for mode in MODES
    ]
    columns = ["env", "label", "seed", "mode", "return", "violation", "lambda"]
    table = pd.DataFrame(rows, columns=None if rows else columns)
    for cost in [name for name in table if name.startswith("cost")]:
        if cost.replace("cost", "limit") not in table:
            table[cost.replace("cost", "limit")] = np.nan
    return table


def evaluation_numbers(evaluation: Mapping[str, Any]) -> dict[str, float]:
    """What ``enjoy`` reports, as columns.

    :param evaluation: See :func:`sb3_e2c.zoo.enjoy.summarize`
    :return: ``return, violation, lambda, cost, limit`` (``cost_0``, ... if there are several)
    """
    numbers = {
        "return": evaluation["team_return"],
        "violation": evaluation["violation_rate"],
        "lambda": evaluation["lambda"] and np.mean(evaluation["lambda"]),
    }
    for name, key in (("cost", "team_cost"), ("limit", "cost_limits")):
        values = [] if evaluation[key] is None else np.atleast_1d(evaluation[key]).tolist()
        numbers |= named_costs(values, name)
    return {name: np.nan if number is None else number for name, number in numbers.items()}
