"""One job of a benchmark: train, evaluate, write the small files; in a process of its own.

The process holds the job's lock as long as it lives, so nobody else works on the same job, and the
lock of a process that was killed is gone with it. It ends when the process that started it does.
"""

import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sb3_e2c.zoo import enjoy, train
from sb3_e2c.zoo.configuration import team_limits
from sb3_e2c.zoo.console import UserError, one_line_errors
from sb3_e2c.zoo.results import MODES, Place, read_json, read_table, write_curve, write_json
from sb3_e2c.zoo.resume import Interrupted, newest_point
from sb3_e2c.zoo.runs import EVALUATION_SEED
from sb3_e2c.zoo.suite import Job

BUSY, INTERRUPTED = 75, 76  # exit statuses: another process works on it; stopped before its end
GRACE = 30.0  # seconds that a stopped job has for saving
_CURVE_EVERY = 10.0  # seconds
_BEGIN = "[job]"  # begins each attempt in log.txt
_PACKAGES = ("sb3_e2c", "stable_baselines3", "torch", "numpy", "gymnasium", "pettingzoo")
_ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


# ------------------------------------------------------------------ in the process of the job


def train_flags(place: Place) -> list[str]:
    """The command line of a job.

    :param place: Where it lies
    """
    job, method = place.job, place.job.method
    flags = ["--algo", method.algo, "--env", job.env, "--preset", method.preset]
    flags += ["--seed", str(job.seed), "-f", str(place.log_folder)]
    flags += ["--eval-freq", "-1", "--verbose", "0"]
    flags += [] if job.n_timesteps is None else ["-n", str(job.n_timesteps)]
    for flag, values in (("--env-kwargs", method.env_kwargs), ("-params", method.params)):
        flags += [flag, *_pairs(values)] if values else []
    return flags


def _pairs(values: Mapping[str, Any], outer: str = "") -> Iterator[str]:
    """Nested mappings as ``outer.inner:value``."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _pairs(value, f"{outer}{key}.")
        else:
            yield f"{outer}{key}:{value!r}"


def continue_or_restart(place: Place) -> list[str]:
    """Flags of ``train`` that finish a job of which nothing, or a part, has been done.

    :param place: Where it lies
    """
    run = place.run
    with suppress(UserError):  # no resume point is whole
        if run is not None and newest_point(run) is not None:
            return ["--resume", str(run)]
    shutil.rmtree(place.log_folder, ignore_errors=True)
    return train_flags(place)


def run_job(place: Place) -> int:
    """Do what is left to do of a job.

    :param place: Where it lies
    :return: Exit status
    :raises UserError: for settings that the zoo refuses
    """
    try:
        with FileLock(place.lock, timeout=0):
            if not place.done.exists():
                print(f"{_BEGIN} {place.job.name}, {_now()}", flush=True)
                return _train_and_evaluate(place)
    except Timeout:
        return BUSY
    return 0


def _train_and_evaluate(place: Place) -> int:
    config = place.job.configuration()
    limits = team_limits(place.job.env, config)
    commit = _commit(Path(__file__).resolve().parents[1])  # before anybody changes the checkout
    _forget_other_settings(place)
    if not _trained(place, config):
        try:
            with _curve_while_running(place, limits):
                train.train(continue_or_restart(place))
        except Interrupted:
            return INTERRUPTED
        if not _trained(place, config):
            return INTERRUPTED
    write_curve(place, limits)
    started = time.time()
    write_json(place.results / "evaluation.json", {mode: _evaluate(place, mode) for mode in MODES})
    place.failure.unlink(missing_ok=True)
    write_json(place.done, _record(place, config, commit, time.time() - started))
    return 0


def _forget_other_settings(place: Place) -> None:
    """Remove what an interrupted job with other settings has left."""
    settings, path = place.job.settings(), place.work / "job.json"
    if path.is_file() and read_json(path) != json.loads(json.dumps(settings)):
        shutil.rmtree(place.log_folder, ignore_errors=True)
    write_json(path, settings)


def _trained(place: Place, config: Mapping[str, Any]) -> bool:
    """Whether training has come to its end; a run that was stopped saves its model, too."""
    run = place.run
    if run is None or not (run / f"{place.job.env}.zip").is_file():
        return False
    return place.steps() >= config["n_timesteps"]


@contextmanager
def _curve_while_running(place: Place, limits: list[float]) -> Iterator[None]:
    """Keep curve.csv up to date."""
    stop = threading.Event()

    def write() -> None:
        while not stop.wait(_CURVE_EVERY):
            with suppress(UserError, OSError, KeyError, IndexError):  # logs just being written
                write_curve(place, limits)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _evaluate(place: Place, mode: str) -> dict[str, Any]:
    job, path = place.job, place.work / f"{mode}.json"
    flags = ["--algo", job.method.algo, "--env", job.env, "-f", str(place.log_folder)]
    flags += ["--n-episodes", str(job.eval_episodes), "--verbose", "0", "--json", str(path)]
    flags += ["--seed", str(EVALUATION_SEED + 100 * job.seed)]
    enjoy.main([*flags, *(["--deterministic"] if mode == "deterministic" else [])])
    result = read_json(path)
    result.pop("model")  # a path on this machine
    result.pop("against", None)  # its own adversary only: the same numbers again
    return result


def _record(
    place: Place, config: dict[str, Any], commit: str | None, evaluation_seconds: float
) -> dict[str, Any]:
    """How a result came about."""
    flags = [word.replace(str(place.log_folder), "logs") for word in train_flags(place)]
    return {
        "job": place.job.settings(),
        "command": shlex.join(["sb3-e2c", "train", *flags]),
        "agent_steps": place.steps(),
        "training_seconds": _training_seconds(place),
        "evaluation_seconds": round(evaluation_seconds, 1),
        "finished": _now(),
        "machine": {"cores": os.cpu_count(), "cpu": _cpu(), "system": platform.system()},
        "versions": {"python": platform.python_version()} | dict(_versions()),
        "commit": commit,
        "config": config,
    }


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def _training_seconds(place: Place) -> float:
    seconds = read_table((place.run or place.work) / "progress.csv")["time/time_elapsed"]
    return float(seconds.dropna().max())


def _versions() -> Iterator[tuple[str, str]]:
    for package in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            yield package, metadata.version(package)


def _commit(root: Path) -> str | None:
    """Of a checkout; None if the folder is none, as that of an installed wheel."""
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty"]
    with suppress(OSError, subprocess.CalledProcessError):  # no git, or not ours
        return subprocess.check_output(command, stderr=subprocess.DEVNULL, text=True).strip()
    return None


def _cpu() -> str:
    """Name of the processor; Python knows it everywhere but on Linux."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _end_with_parent() -> None:
    """Ask this process to stop as soon as the one that holds the other end of stdin is gone."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(INTERRUPTED)

    threading.Thread(target=wait, daemon=True).start()


def main() -> None:
    """``python -m sb3_e2c.zoo.jobs FOLDER JOB``: the process that :func:`start` starts."""
    folder, settings = sys.argv[1:]
    _end_with_parent()
    with one_line_errors():
        status = run_job(Place(Path(folder), Job.from_settings(json.loads(settings))))
    if status == INTERRUPTED:
        print("stopped before the end of training")
    raise SystemExit(status)


# ------------------------------------------------------------------ in the process that starts it


def command(place: Place) -> list[str]:
    """The process of a job.

    :param place: Where it lies
    """
    settings = json.dumps(place.job.settings())
    return [sys.executable, "-m", "sb3_e2c.zoo.jobs", str(place.folder.absolute()), settings]


def start(place: Place) -> subprocess.Popen[bytes]:
    """Start a job; it stops when this process ends, however that comes about.

    :param place: Where it lies
    """
    place.work.mkdir(parents=True, exist_ok=True)
    with place.log.open("ab") as log:
        return subprocess.Popen(
            command(place),
            stdin=subprocess.PIPE,  # never written to: it closes with this process
            stdout=log,
            stderr=subprocess.STDOUT,
            env=dict.fromkeys(_ONE_THREAD, "1") | os.environ,
            start_new_session=True,  # Ctrl-C reaches it through us only
        )


def stop(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ask processes to save and end, and end those that do not.

    :param processes: Made by :func:`start`
    """
    _signal(processes, signal.SIGTERM)
    try:
        deadline = time.monotonic() + GRACE
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(deadline - time.monotonic(), 0.0))
    finally:  # also if the user is impatient
        _signal(processes, signal.SIGKILL)
        for process in processes:
            process.wait()
            let_go(process)


def let_go(process: subprocess.Popen[bytes]) -> None:
    """Close our end of its stdin.

    :param process: One that has ended
    """
    if process.stdin is not None:
        process.stdin.close()


def _signal(processes: list[subprocess.Popen[bytes]], number: int) -> None:
    for process in processes:
        if process.poll() is None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, number)


def is_busy(place: Place) -> bool:
    """Whether some process works on a job.

    :param place: Where it lies
    """
    if not place.lock.exists():
        return False
    try:
        with FileLock(place.lock, timeout=0):
            return False
    except Timeout:
        return True


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    :param place: Where it lies
    :param status: Exit status; negative: the signal that ended it
    :param message: The last line of its output, if it failed
    """

    place: Place
    status: int
    message: str = ""

    @property
    def failed(self) -> bool:
        """Whether something has to be done about it."""
        return self.status not in (0, BUSY)


def outcome_of(place: Place, status: int) -> Outcome:
    """Record how a job ended.

    :param place: Where it lies
    :param status: Exit status of its process
    """
    if status in (0, BUSY):
        return Outcome(place, status)
    lines: list[str] = []
    with suppress(OSError):
        lines = place.log.read_text(errors="replace").splitlines()
    begins = [number for number, line in enumerate(lines) if line.startswith(_BEGIN)]
    return record_failure(place, status, lines[begins[-1] if begins else 0 :][-20:])


def record_failure(place: Place, status: int, lines: list[str]) -> Outcome:
    """Write failure.json.

    :param place: Where the job lies
    :param status: Exit status of its process
    :param lines: The last lines of its output
    """
    ended = f"ended by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
    write_json(place.failure, {"status": status, "ended": ended, "last_lines": lines})
    last = next((line for line in reversed(lines) if line.strip()), "no output")
    message = last.removeprefix("sb3-e2c: error: ")
    return Outcome(place, status, message if status == 2 else f"{message} ({ended})")


def refuse(place: Place, error: UserError) -> Outcome:
    """Record a job that cannot even start.

    :param place: Where it lies
    :param error: Why
    """
    return record_failure(place, 2, [str(error)])


if __name__ == "__main__":
    main()
