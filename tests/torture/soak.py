"""A long training must not grow: memory, open files, threads, what callbacks remember, its files.

    PYTHONPATH=tests python -m torture.soak --minutes 120 -o soak

trains E2C on rovers, with GRUs, and against an adversary, a third of the time each, and writes
soak/NAME.csv, a row every few seconds, soak/NAME.png, and a table; exit status 1 if anything grows.
Linux only: it reads /proc.
"""

import argparse
import csv
import functools
import os
import signal
import sys
import time
from collections import deque
from pathlib import Path
from types import MemberDescriptorType, ModuleType

import numpy as np
import torch as th
from matplotlib.figure import Figure
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c import OEMRewardCallback, TeamEvalCallback
from sb3_e2c.zoo import train
from sb3_e2c.zoo.resume import KeepPoints
from torture.runs import PREY, ROVERS, Outcome, flags, fork, wait

PAGE = os.sysconf("SC_PAGE_SIZE")
TRAININGS = {
    "rovers": ["--env", ROVERS],
    "gru": ["--env", ROVERS, "--preset", "gru"],
    "adversary": ["--env", PREY],
}
INSIDE = ("estimator_kib", "callbacks_kib", "episodes_kept", "evaluations")
COLUMNS = ("seconds", "rss_mib", "handles", "threads", "progress_kib", "monitor_kib", "other_kib")
COLUMNS += ("agent_steps", *INSIDE)
# What must not grow after the first third, and by how much it may differ all the same. RSS depends
# on what the allocator keeps; other files are models and resume points, compressed.
CONSTANT = {"rss_mib": 8.0, "handles": 0.5, "threads": 0.5, "other_kib": 64.0}
CONSTANT |= {"estimator_kib": 0.1, "callbacks_kib": 64.0, "episodes_kept": 0.5}
LOGS = 400.0  # most KiB of logs for a million agent steps


def measure(pid="self"):
    """Resident memory in MiB, open files and threads of a process."""
    resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 2**20
    return resident, *(len(os.listdir(f"/proc/{pid}/{name}")) for name in ("fd", "task"))


# ---------------------------------------------------------------------------- inside the training


LEFT_OUT = (BaseAlgorithm, VecEnv, Logger, type, ModuleType)
PLAIN = {bool, int, float, complex, str, bytes, bytearray, type(None)}


def held(thing):
    """Bytes of all that an object holds, without models, worlds and loggers."""
    total, waiting, seen = 0, [thing], set()
    while waiting:
        each = waiting.pop()
        plain = type(each) in PLAIN  # asked first, because abstract classes are slow to ask
        if id(each) in seen or (not plain and isinstance(each, LEFT_OUT)):
            continue
        seen.add(id(each))
        if not plain and isinstance(each, (np.ndarray, th.Tensor)):
            total += each.nbytes
            continue
        total += sys.getsizeof(each)
        waiting += [] if plain else _inner(each)
    return total


def _inner(thing):
    inner = [getattr(thing, name) for name in _slots(type(thing)) if hasattr(thing, name)]
    inner += vars(thing).values() if hasattr(thing, "__dict__") else []
    if isinstance(thing, dict):
        inner += [*thing, *thing.values()]
    inner += thing if isinstance(thing, (list, tuple, set, frozenset, deque)) else []
    return inner


@functools.cache
def _slots(kind):
    """Attributes of ``__slots__`` by the names under which they are stored, private ones too."""
    bases = [vars(base) for base in kind.__mro__ if "__slots__" in vars(base)]
    pairs = [pair for base in bases for pair in base.items()]
    return [name for name, member in pairs if isinstance(member, MemberDescriptorType)]


def inside(callbacks, model):
    """The columns of ``INSIDE``.

    Results of evaluations are kept, as Stable-Baselines3 does. Neither they are counted nor the two
    resume points (``points``), which hold them again.
    """
    found = {type(each): each for each in callbacks}
    oem, evaluations = found[OEMRewardCallback], found[TeamEvalCallback]
    others = [vars(each) for each in callbacks if each is not evaluations]
    left_out = ("locals", "globals", "points")
    own = [{k: v for k, v in each.items() if k not in left_out} for each in others]
    counts = len(model.ep_info_buffer), len(evaluations.evaluations_timesteps)
    return held(oem.estimator) / 1024, held(own) / 1024, *counts


def _train(argv, path, every):
    """In a child process: train, and write down the columns of ``INSIDE``."""
    real, last = KeepPoints._on_rollout_start, [0.0]

    def on_rollout_start(self):
        real(self)
        if time.monotonic() - last[0] > every / 2:
            last[0] = time.monotonic()
            numbers = inside(_flat(self._everything.callbacks), self.model)
            path.with_suffix(".new").write_text(" ".join(map(str, numbers)))
            path.with_suffix(".new").replace(path)

    KeepPoints._on_rollout_start = on_rollout_start
    train.main(argv)


def _flat(callbacks: list[BaseCallback]) -> list[BaseCallback]:
    inner = [getattr(each, "callbacks", [each]) for each in callbacks]
    return [each for few in inner for each in few]


# ---------------------------------------------------------------------------- from outside


def soak(name, minutes, out, every=5.0):
    """Train in a child process, and look at it from here.

    :param name: A key of ``TRAININGS``
    :return: The csv file
    """
    out.mkdir(parents=True, exist_ok=True)
    logs, path, note = out / f"{name}_logs", out / f"{name}.csv", out / f"{name}.inside"
    argv = [*TRAININGS[name], "--algo", "e2c_t", "-f", str(logs), "-n", str(10**12), "--verbose"]
    argv += ["0", "--device", "cpu", "--eval-freq", "100000", "--eval-episodes", "10"]
    argv += ["--resume-every", "10"]
    pid = fork(_train, argv, note, every)
    try:
        with path.open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(COLUMNS)
            for row in _samples(pid, logs, note, 60 * minutes, every):
                table.writerow([round(number, 2) for number in row])
                file.flush()
    finally:
        os.kill(pid, signal.SIGTERM)
        status = wait(pid)
        note.unlink(missing_ok=True)
    if status != 128 + signal.SIGTERM:
        raise RuntimeError(f"the training ended with status {status}")
    return path


def _samples(pid, logs, note, seconds, every):
    """Rows of the table, from the moment when there is something to see inside."""
    start = time.monotonic()
    while time.monotonic() - start < seconds:
        time.sleep(every)
        if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return
        runs = sorted(logs.glob("*/*_*"), key=lambda run: int(run.name.rpartition("_")[2]))
        if not note.exists() or not runs:
            continue
        sizes = _sizes(runs[-1])
        points = [int(name.split(".")[0]) for name in sizes if name.endswith(".point")]
        files = [sizes.pop(f"{name}.csv", 0) / 1024 for name in ("progress", "monitor")]
        files += [sum(sizes.values()) / 1024, max(points, default=0)]
        yield time.monotonic() - start, *measure(pid), *files, *map(float, note.read_text().split())


def _sizes(run):
    """Bytes of a run's files; of two resume points the newer one, of evaluations none: they add up.

    A file may get its name, or lose it, while we look.
    """
    found = {}
    for path in run.rglob("[!.]*"):
        try:
            found[path.name] = path.stat().st_size if path.is_file() else 0
        except FileNotFoundError:
            continue
    points = sorted(name for name in found if name.endswith(".point"))
    return {k: v for k, v in found.items() if k not in ("evaluations.npz", *points[:-1])}


# ---------------------------------------------------------------------------- judgement


def warm(table):
    """Rows after the first third of the time, and after the first evaluation."""
    seconds = table["seconds"]
    return table[(seconds >= seconds[0] + np.ptp(seconds) / 3) & (table["evaluations"] > 0)]


def growth(times, values, blocks=12):
    """How much numbers grow in some time, and how sure that is.

    :return: Slope times duration, of a line through the medians of blocks, and its standard error
    """
    pieces = np.array_split(np.arange(len(times)), blocks)
    x = np.array([times[each].mean() for each in pieces])
    y = np.array([np.median(values[each]) for each in pieces])
    x = (x - x.mean()) / np.ptp(times)
    slope = (x @ y) / (x @ x)
    rest = y - y.mean() - slope * x
    return slope, np.sqrt(rest @ rest / (blocks - 2) / (x @ x))


def verdicts(path):
    """What grew and by how much, for each column of ``CONSTANT`` and the logs.

    :return: Lines: column, smallest, largest, growth, its standard error, whether that is too much
    """
    table = warm(np.genfromtxt(path, delimiter=",", names=True))
    for column, tolerance in CONSTANT.items():
        grown, error = growth(table["seconds"], table[column])
        bad = grown > tolerance and grown > 3 * error
        yield column, table[column].min(), table[column].max(), grown, error, bool(bad)
    logs = table["progress_kib"] + table["monitor_kib"]
    rate = 1e6 * np.ptp(logs) / max(np.ptp(table["agent_steps"]), 1)
    yield "log KiB/1M steps", logs.min(), logs.max(), rate, 0.0, bool(rate > LOGS)


def report(name, path):
    """Print the verdicts.

    :return: Whether anything grew, or it was too short to know
    """
    table = np.genfromtxt(path, delimiter=",", names=True)
    if len(warm(np.atleast_1d(table))) < 12:
        print(f"{name:<10} too short to know", flush=True)
        return True
    row = "{:<10} {:<18}{:>10.1f}{:>10.1f}{:>+10.2f} ± {:<8.2f}{}".format
    found = list(verdicts(path))
    for *numbers, bad in found:
        print(row(name, *numbers, "GROWS" if bad else ""), flush=True)
    return any(bad for *_, bad in found)


def plot(path):
    """Draw memory and open files over time, beside the csv file."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    figure = Figure(figsize=(8, 4), layout="constrained")
    for axes, column in zip(figure.subplots(2, 1, sharex=True), COLUMNS[1:3], strict=True):
        axes.plot(table["seconds"] / 60, table[column])
        axes.set_ylabel(column)
        axes.set_ylim(bottom=0)
    axes.set_xlabel("minutes")
    figure.savefig(path.with_suffix(".png"))


# ---------------------------------------------------------------------------- the short form


def grows(folder, rollouts=200):
    """Many short rollouts with everything that ``train`` has; what grew in the last half of them.

    :return: MiB of memory, handles, threads, rows of progress.csv a rollout, largest sizes that
        must not grow: of the estimator's memory in observations, of the episodes that the model
        keeps, and of resume points in number
    """
    seen, real = [], KeepPoints._on_rollout_start

    def on_rollout_start(self):
        real(self)
        oem = next(c for c in self._everything.callbacks if isinstance(c, OEMRewardCallback))
        capacity = oem.estimator._memory.columns.shape[2]
        points = len(list(self.points.run.glob("resume/*.point")))
        kept = len(self.model.ep_info_buffer)
        seen.append((*measure(), self.points.progress.n_rows, capacity, kept, points))

    KeepPoints._on_rollout_start = on_rollout_start
    try:
        train.train(flags(folder, ROVERS, rollouts))
    finally:
        KeepPoints._on_rollout_start = real
    table = np.array(seen)
    grown = table[-1] - table[len(table) // 2]
    rows = grown[3] / (len(table) - len(table) // 2)
    return *grown[:3], rows, table[:, 4:].max(axis=0)


def torture(folder, rollouts=200):
    """A line of the table.

    :param folder: An empty folder
    """
    memory, handles, threads, rows, (capacity, kept, points) = grows(folder, rollouts)
    found = {
        f"memory grew by {memory:.1f} MiB": memory > 4,
        f"handles grew by {handles}": handles > 0,
        f"threads grew by {threads}": threads > 0,
        f"{rows:.1f} rows of progress.csv for each rollout": rows > 2,
        f"an estimator remembers {capacity} observations": capacity > 64,
        f"the model keeps {kept} episodes": kept > 100,
        f"{points} resume points": points > 2,
    }
    notes = tuple(what for what, wrong in found.items() if wrong)
    yield Outcome(f"soak: {rollouts} rollouts", len(found), wrong=len(notes), notes=notes)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=120, help="of all trainings together")
    parser.add_argument("--only", choices=TRAININGS, help="one training instead of all in turns")
    parser.add_argument("-o", "--out", type=Path, default=Path("soak"))
    args = parser.parse_args()
    names = [args.only] if args.only else list(TRAININGS)
    row = "{:<10} {:<18}{:>10}{:>10}{:>10}".format
    print(row("training", "column", "smallest", "largest", "growth"), flush=True)
    grown = []
    for name in names:
        minutes = args.minutes / len(names)
        path = soak(name, minutes, args.out, every=min(5.0, minutes))
        plot(path)
        grown.append(report(name, path))
    sys.exit(int(any(grown)))


if __name__ == "__main__":
    main()
