"""Resume points: what a killed run goes on from (``sb3-e2c train --resume RUN``).

    RUN/resume/000000049152.point   the newest; the one before it stays until this one is whole
    RUN/resume/lock                 held by the process that trains

A point is one file: a checksum of what follows, a line of JSON about the run (read without
unpickling), and the state of :mod:`sb3_e2c.resume`. It is kept between two rollouts, together with
how far the logs had come, so that later rows can be cut off.
"""

import functools
import hashlib
import json
import math
import os
import re
import shlex
import signal
import threading
import time
from argparse import Namespace
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

from filelock import FileLock, Timeout
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import KVWriter, TensorBoardOutputFormat, filter_excluded_keys
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c import MAPPO, TeamEvalCallback
from sb3_e2c.resume import keeps_episodes, load_training_state, training_state
from sb3_e2c.zoo.configuration import read_yaml
from sb3_e2c.zoo.console import UserError, brief, write_whole

FOLDER = "resume"
_SUFFIX = ".point"
_PACKAGES = ("sb3_e2c", "stable_baselines3", "torch", "numpy", "numba")
_DIGEST = 64  # hexadecimal digits of a checksum
_KEEP_EVERY = 1.0  # seconds; a point in memory costs some milliseconds, short rollouts few more
# What atomic_write leaves when it is killed
_LEFTOVER = re.compile(r"\..+\.[a-z0-9_]{8}")


class NothingToDo(Exception):
    """A run to be resumed has come to its end."""


class Stopped(KeyboardInterrupt):
    """A signal asks this process to end.

    :param number: Of the signal
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.number = number


class Interrupted(SystemExit):
    """A training was stopped by a signal; the exit status is a shell's, 128 + its number.

    :param number: Of the signal
    """

    def __init__(self, number: int):
        super().__init__(128 + number)


_STOP_SIGNALS = [getattr(signal, s) for s in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, s)]


@contextmanager
def stop_signals() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP raise :class:`Stopped`, unless they were ignored."""
    owner = os.getpid()

    def stop(number: int, _: Any) -> None:
        if os.getpid() == owner:
            raise Stopped(number)
        if number == signal.SIGTERM:  # a worker process, which its parent ends in all other cases
            os._exit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {s: signal.getsignal(s) for s in _STOP_SIGNALS}
    for number, handler in before.items():
        if handler != signal.SIG_IGN:  # for instance nohup's
            signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_stop_signals() -> None:
    """Save undisturbed, until :func:`stop_signals` ends."""
    if threading.current_thread() is threading.main_thread():
        for number in _STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)


@dataclass(frozen=True)
class Point:
    """A resume point.

    :param about: Plain data about the run
    :param state: What :func:`sb3_e2c.resume.training_state` returned
    """

    about: dict[str, Any]
    state: bytes

    @property
    def steps(self) -> int:
        """Agent steps done."""
        return self.about["steps"]

    @property
    def is_last(self) -> bool:
        """Whether training had come to its end, and the model was saved."""
        return self.about["finished"]

    def to_bytes(self) -> bytes:
        """The content of its file."""
        body = json.dumps(self.about).encode() + b"\n" + self.state
        return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def read_point(path: Path) -> Point:
    """Read a resume point; nothing in it is unpickled.

    :param path: Its file
    :raises ValueError: if it is damaged
    """
    content = path.read_bytes()
    body = content[_DIGEST + 1 :]
    if content[: _DIGEST + 1] != hashlib.sha256(body).hexdigest().encode() + b"\n":
        raise ValueError("its checksum is wrong")
    about, _, state = body.partition(b"\n")
    return Point(json.loads(about), state)


def newest_point(run: Path) -> Point | None:
    """The newest resume point that is whole; says so if a newer one is damaged.

    :param run: The run's folder
    :return: None if there is none at all
    :raises UserError: if all are damaged
    """
    damaged: list[str] = []
    for path in sorted((run / FOLDER).glob(f"*{_SUFFIX}"), reverse=True):
        try:
            point = read_point(path)
        except (OSError, ValueError) as error:
            damaged.append(f"{path} is damaged ({brief(error)})")
            continue
        for each in damaged:
            print(f"{each}: going back to the one before it, {path.name}")
        return point
    if damaged:
        raise UserError(f"{'; '.join(damaged)}; there is no other resume point: train anew")
    return None


# ------------------------------------------------------------------ logs


class ProgressFile(KVWriter):
    """``progress.csv``, as Stable-Baselines3's, but never half-written, and able to go on.

    :param path: The file
    :param n_rows: How many rows of it to keep
    """

    _file: TextIO

    def __init__(self, path: Path, n_rows: int = 0):
        self.path = path
        lines = path.read_text().splitlines(keepends=True)[: n_rows + 1] if n_rows else []
        self.n_rows = max(len(lines) - 1, 0)
        self.keys = lines[0].rstrip("\n").split(",") if lines else []
        self._rewrite(lines)

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,  # noqa: ARG002
    ) -> None:
        """Append a row, and columns at its first numbers of a new kind."""
        values = filter_excluded_keys(key_values, key_excluded, "csv")
        if not values.keys() <= set(self.keys):
            self._add_columns(sorted(values.keys() - set(self.keys)))
        self._file.write(",".join(_cell(values.get(key)) for key in self.keys) + "\n")
        self._file.flush()
        self.n_rows += 1

    def _add_columns(self, keys: list[str]) -> None:
        rows = self.path.read_text().splitlines()[1:]
        all_keys = [*self.keys, *keys]
        self._file.close()  # not every system replaces an open file
        try:
            head = ",".join(all_keys) + "\n"
            self._rewrite([head, *(row + "," * len(keys) + "\n" for row in rows)])
        except OSError:
            self._file = self.path.open("a")  # go on with what is there
            raise
        self.keys = all_keys

    def _rewrite(self, lines: list[str]) -> None:
        write_whole(self.path, "".join(lines))
        self._file = self.path.open("a")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return '"' + value.replace('"', '""') + '"' if isinstance(value, str) else str(value)


def tensorboard_format(folder: str, steps: int) -> TensorBoardOutputFormat:
    """TensorBoard's files.

    :param folder: Where they are
    :param steps: At which the run goes on; what was written for later ones is hidden
    """
    logs = TensorBoardOutputFormat(folder)
    if steps > 0:
        logs.writer.close()
        logs.writer = type(logs.writer)(log_dir=folder, purge_step=steps + 1)
    return logs


def _sync(path: Path) -> None:
    """Have a file on the disk before a resume point that counts on it."""
    if path.exists():
        with path.open("r+b") as file:
            os.fsync(file.fileno())


# ------------------------------------------------------------------ a run

# Flags that may differ from those that a run was started with
_MAY_DIFFER = {
    *("resume", "resume_every", "n_timesteps", "verbose", "progress", "device", "trust"),
}


def resumed_arguments(
    run: Path, given: Mapping[str, Any], defaults: Mapping[str, Any], flags: Mapping[str, str]
) -> Namespace:
    """The command line that goes on with a run.

    :param run: Its folder
    :param given: What was typed, by destination
    :param defaults: Values of all flags that were not
    :param flags: Names of the flags by destination
    :return: The run's own flags, with those that may be changed
    :raises UserError: if there is no run, or flags contradict it
    """
    started = {**defaults, **_started_with(run)}
    for name in given.keys() - _MAY_DIFFER:
        if given[name] != started[name]:
            raise UserError(
                f"--resume {run} goes on with {flags[name]} {started[name]}, and {flags[name]} "
                f"{given[name]} contradicts it; leave it away, or start a new run"
            )
    # The point holds what -i had loaded, and the total that -n asked for; trust is not inherited.
    always = {"n_timesteps": -1, "trained_agent": "", "trust": False}
    always["log_folder"] = str(run.absolute().parents[1])
    return Namespace(**started | always | {k: given[k] for k in given.keys() & _MAY_DIFFER})


def _started_with(run: Path) -> dict[str, Any]:
    found = list(run.glob("*/args.yml"))
    if len(found) != 1:
        raise UserError(
            f"--resume {run}: no run of train is there; expected a folder like "
            "logs/e2c_t/MultiRover-6-3-v0_1"
        )
    return read_yaml(found[0])


def how_to_go_on(run: Path) -> str:
    """The command that resumes a run.

    :param run: Its folder
    """
    return f"sb3-e2c train --resume {shlex.quote(str(run))}"


class Resumable:
    """The resume points of one run, and the right to train it.

    :param run: The run's folder
    :param every: Seconds between points on the disk; 0: one after every rollout
    :param resumes: Whether to go on from its newest point
    """

    def __init__(self, run: Path, every: float, resumes: bool):
        self.run, self.every = run, every
        self.start: Point | None = None  # what this process goes on from
        self.latest: Point | None = None  # perhaps only in memory
        self.total = -1  # agent steps at which a resumed run ends
        self.progress: ProgressFile | None = None
        self.tensorboard: str | None = None
        self._resumes = resumes
        self._config: dict[str, Any] = {}
        self._keeps_episodes = True
        self._written: Point | None = None
        self._written_at = self._kept_at = -math.inf
        self._lock = FileLock(run / FOLDER / "lock", timeout=0)

    @property
    def steps(self) -> int:
        """Agent steps from which this process goes on."""
        return 0 if self.start is None else self.start.steps

    @property
    def monitor(self) -> Path:
        """The csv file of episodes."""
        return self.run / "monitor.csv"

    def open(self, config: Mapping[str, Any], total: int = -1) -> None:
        """Take the run, alone; if it is resumed, read its newest point.

        :param config: Its configuration
        :param total: Agent steps at which a resumed run shall end; -1: as it was started
        :raises UserError: if another process trains it, there is no point, or it is beyond total
        :raises NothingToDo: if it has come to its end
        """
        self._config = json.loads(json.dumps(dict(config), default=str))
        try:
            (self.run / FOLDER).mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
        except Timeout:
            raise UserError(
                f"{self.run} is being trained by another process; wait for it"
            ) from None
        if not self._resumes:
            return
        self.start = self.latest = self._written = _required(self.run)
        self._written_at = time.monotonic()
        self.tensorboard = self.start.about["tensorboard"]
        planned = self.start.about["total"]
        self.total = total if total > 0 else planned
        done = f"{self.steps:,} agent steps are done"
        if self.start.is_last and (self.steps >= self.total or self.total == planned):
            raise NothingToDo(f"{self.run}: nothing to do, {done}")
        if self.steps >= self.total:
            raise UserError(
                f"{self.run}: {done}, more than -n {self.total}, and the model has not been saved "
                "since; expected a larger -n, or none to finish the run"
            )
        if self.total != planned:
            print(f"To {self.total:,} agent steps, not {planned:,}; schedules follow the new total")

    def cut_logs(self) -> None:
        """Forget what was written after the point, so that it is not there twice."""
        if self.start is None:
            return
        for folder in (self.run, self.run / FOLDER):
            for path in folder.glob(".*"):
                if _LEFTOVER.fullmatch(path.name) and path.is_file():
                    path.unlink()
        self._cut_monitor(self.start.about["monitor_bytes"])

    def _cut_monitor(self, size: int) -> None:
        found = self.monitor.stat().st_size if self.monitor.exists() else 0
        if found < size:
            print(f"{self.monitor} is shorter than it was: episodes are missing in it")
        elif size == 0:
            self.monitor.unlink(missing_ok=True)
        else:
            os.truncate(self.monitor, size)

    def _describe(self, about: dict[str, Any], device: str) -> list[str]:
        """Where the run goes on, and why the result may differ from an uninterrupted run's."""
        doubts = []
        if not about["episodes"]:
            doubts.append("its worlds do not run in a batched simulator and begin new episodes")
        then = about["config"]
        changed = [k for k in {**then, **self._config} if then.get(k) != self._config.get(k)]
        if changed:
            doubts.append(f"config.yml was changed ({', '.join(sorted(changed))})")
        for thing, now in {**_versions(), "device": device}.items():
            if about["made_with"].get(thing) != now:
                doubts.append(f"{thing} was {about['made_with'].get(thing)} and is now {now}")
        exactly = "" if doubts else ", bit for bit"
        line = f"Resuming {self.run} at {about['steps']:,} agent steps{exactly}"
        return [line, *(f"Not exactly as if never interrupted: {doubt}" for doubt in doubts)]

    def world_seed(self, seed: int) -> int:
        """Seed of the first world.

        :param seed: Of the run; worlds that begin new episodes shall not see the old ones again
        """
        if self.start is None or self.start.about["episodes"]:
            return seed
        return seed + self.start.steps

    def progress_file(self) -> ProgressFile:
        """The csv file of the log, with the rows that were there at the point."""
        n_rows = 0 if self.start is None else self.start.about["progress_rows"]
        path = self.run / "progress.csv"
        self.progress = ProgressFile(path, n_rows if path.exists() else 0)
        if self.progress.n_rows < n_rows:
            print(f"{path} is shorter than it was: rows are missing in it")
        return self.progress

    def restore(self, model: MAPPO, callback: BaseCallback) -> None:
        """Set everything to where the run was.

        :param model: Just built
        :param callback: All callbacks of its ``learn``
        """
        assert self.start is not None
        try:
            load_training_state(model, callback, self.start.state)
        except Exception as error:  # whatever a pickle of another version may raise
            raise UserError(
                f"cannot go on from {self._path(self.start)}: {brief(error)}"
            ) from error
        for line in self._describe(self.start.about, str(model.device)):
            print(line)

    def keep(self, model: MAPPO, callback: BaseCallback, finished: bool = False) -> None:
        """Make a point, in memory.

        :param model: What trains
        :param callback: All callbacks of its ``learn``
        :param finished: Whether training is over
        """
        assert self.progress is not None
        self._kept_at = time.monotonic()
        about = {
            "steps": model.num_timesteps,
            "total": model._total_timesteps,
            "finished": finished,
            "episodes": self._keeps_episodes,
            "monitor_bytes": self.monitor.stat().st_size if self.monitor.exists() else 0,
            "progress_rows": self.progress.n_rows,
            "tensorboard": self.tensorboard,
            "config": self._config,
            "made_with": {**_versions(), "device": str(model.device)},
        }
        self.latest = Point(about, training_state(model, callback, self._keeps_episodes))

    @property
    def is_due(self) -> bool:
        """Whether the latest point is old enough for another one."""
        return time.monotonic() - self._kept_at >= min(self.every, _KEEP_EVERY)

    def check_worlds(self, *envs: VecEnv) -> None:
        """See whether running episodes can be kept.

        :param envs: Of the training and of evaluations
        """
        self._keeps_episodes = all(keeps_episodes(env) for env in envs)

    def write(self) -> None:
        """Write the latest point to the disk, and remove all but the one before it."""
        if self.latest is None or self.latest is self._written:
            return
        self.check_there()
        _sync(self.monitor)
        _sync(self.run / "progress.csv")
        path = self._path(self.latest)
        write_whole(path, self.latest.to_bytes())
        kept = {path} if self._written is None else {path, self._path(self._written)}
        for other in path.parent.glob(f"*{_SUFFIX}"):
            if other not in kept:
                other.unlink(missing_ok=True)
        self._written, self._written_at = self.latest, time.monotonic()

    def write_if_due(self) -> None:
        """Write the latest point if the last one is old enough."""
        if self._written is None or time.monotonic() - self._written_at >= self.every:
            self.write()

    def check_there(self) -> None:
        """Raise if the folder is gone: writing would make one that nobody can resume."""
        if not Path(self._lock.lock_file).exists():
            raise FileNotFoundError(
                f"{self.run} was deleted or renamed while it trained; if it has another name now, "
                f"go on with: {how_to_go_on(Path('ITS-NEW-NAME'))}"
            )

    def _path(self, point: Point) -> Path:
        return self.run / FOLDER / f"{point.steps:012}{_SUFFIX}"

    def close(self) -> None:
        """Let others train the run."""
        self._lock.release()


class KeepPoints(BaseCallback):
    """Keeps a resume point after every rollout, and begins with one; the last of all callbacks.

    :param points: Those of the run
    """

    model: MAPPO

    def __init__(self, points: Resumable):
        super().__init__()
        self.points = points
        self._restored = points.start is None

    @property
    def _everything(self) -> BaseCallback:
        """What was given to ``learn``, and what it added."""
        return self.locals["callback"]

    def _on_rollout_start(self) -> None:
        self.points.check_there()
        if not self._restored:
            self._restored = True
            self._restore()
        elif self.points.is_due:
            self.points.keep(self.model, self._everything)
        self.points.write_if_due()

    def _restore(self) -> None:
        self.points.restore(self.model, self._everything)
        for each in self._everything.callbacks:  # type: ignore[attr-defined]  # a CallbackList
            if isinstance(each, TeamEvalCallback):
                each.write_evaluations()
            if isinstance(each, ProgressBarCallback):
                each.pbar.update(self.model.num_timesteps)
        assert self.points.start is not None
        if self.points.start.is_last:  # it was kept where no rollout followed
            self._everything.on_rollout_start()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.points.keep(self.model, self._everything, finished=True)


def _required(run: Path) -> Point:
    point = newest_point(run)
    if point is None:
        raise UserError(
            f"{run} has no resume point: it was stopped before training began, or by a version "
            "that kept none; train anew"
        )
    return point


@functools.cache
def _versions() -> dict[str, str]:
    return {package: metadata.version(package) for package in _PACKAGES}
