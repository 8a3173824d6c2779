"""A long training must not grow: memory, open files, memories of callbacks, files it writes.

    PYTHONPATH=tests python -m torture.soak --env MultiRover-6-3-v0 --minutes 120 -o soak

writes soak/ENV.csv, a row every few seconds, and soak/ENV.png. Linux only: it reads /proc.
"""

import argparse
import csv
import os
import signal
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sb3_e2c import OEMRewardCallback
from sb3_e2c.zoo import train
from sb3_e2c.zoo.resume import KeepPoints
from torture.runs import ROVERS, Outcome, flags, fork, wait

PAGE = os.sysconf("SC_PAGE_SIZE")
COLUMNS = ("seconds", "rss_mib", "handles", "log_kib", "other_kib", "agent_steps")


def measure(pid="self"):
    """Resident memory in MiB and open files of a process."""
    resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 2**20
    return resident, len(os.listdir(f"/proc/{pid}/fd"))


def soak(env, minutes, out, every=5.0):
    """Train in a child process, and look at it from here.

    :return: The csv file
    """
    out.mkdir(parents=True, exist_ok=True)
    argv = ["--algo", "e2c_t", "--env", env, "-f", str(out / "logs"), "-n", str(10**12)]
    argv += ["--verbose", "0", "--device", "cpu", "--eval-freq", "200000", "--eval-episodes", "10"]
    pid = fork(train.main, argv)
    path = out / f"{env}.csv"
    try:
        with path.open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(COLUMNS)
            for row in _samples(pid, out / "logs", env, 60 * minutes, every):
                table.writerow(row)
                file.flush()
    finally:
        os.kill(pid, signal.SIGTERM)
        status = wait(pid)
    if status != 128 + signal.SIGTERM:
        raise RuntimeError(f"the training ended with status {status}")
    return path


def _samples(pid, logs, env, seconds, every):
    start = time.monotonic()
    while time.monotonic() - start < seconds:
        time.sleep(every)
        if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return
        runs = sorted(logs.glob(f"*/{env}_*"), key=lambda run: int(run.name.rpartition("_")[2]))
        sizes = _sizes(runs[-1]) if runs else {}
        in_logs = sum(sizes.get(name, 0) for name in ("monitor.csv", "progress.csv"))
        points = [int(name.split(".")[0]) for name in sizes if name.endswith(".point")]
        resident, handles = measure(pid)
        other = sum(sizes.values()) - in_logs
        yield (
            *(round(time.monotonic() - start, 1), round(resident, 2), handles),
            *(round(in_logs / 1024, 1), round(other / 1024, 1), max(points, default=0)),
        )


def _sizes(run):
    found = {}
    for path in run.rglob("*"):
        try:
            found[path.name] = path.stat().st_size if path.is_file() else 0
        except FileNotFoundError:  # a temporary file that has got its name
            continue
    return found


def slopes(path):
    """Growth in the second half: MiB an hour, handles, KiB of logs a million agent steps."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    late = table[len(table) // 2 :]
    hours = late["seconds"] / 3600
    memory = np.polyfit(hours, late["rss_mib"], 1)[0]
    steps = np.ptp(late["agent_steps"])
    logs = np.ptp(late["log_kib"]) / steps * 1e6 if steps else float("nan")
    return {
        "MiB/h": memory,
        "rss MiB": (late["rss_mib"].min(), late["rss_mib"].max()),
        "handles": (table["handles"].min(), late["handles"].min(), late["handles"].max()),
        "log KiB per million agent steps": logs,
        "other KiB": (late["other_kib"].min(), late["other_kib"].max()),
        "agent steps": table["agent_steps"].max(),
    }


def grows(folder, rollouts=200):
    """Many short rollouts with everything that ``train`` has; what grew in the last half of them.

    :return: MiB of memory, handles, rows of progress.csv a rollout, largest sizes that must not
        grow: of the estimator's memory in observations, of the episodes that the model keeps, and
        of resume points in number
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
    growth = table[-1] - table[len(table) // 2]
    return (
        growth[0],
        growth[1],
        growth[2] / (len(table) - len(table) // 2),
        table[:, 3:].max(axis=0),
    )


def torture(folder, rollouts=200):
    """A line of the table.

    :param folder: An empty folder
    """
    memory, handles, rows, (capacity, kept, points) = grows(folder, rollouts)
    found = {
        f"memory grew by {memory:.1f} MiB": memory > 4,
        f"handles grew by {handles}": handles > 0,
        f"{rows:.1f} rows of progress.csv for each rollout": rows > 2,
        f"an estimator remembers {capacity} observations": capacity > 64,
        f"the model keeps {kept} episodes": kept > 100,
        f"{points} resume points": points > 2,
    }
    notes = tuple(what for what, wrong in found.items() if wrong)
    yield Outcome(f"soak: {rollouts} rollouts", len(found), wrong=len(notes), notes=notes)


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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="MultiRover-6-3-v0")
    parser.add_argument("--minutes", type=float, default=120)
    parser.add_argument("-o", "--out", type=Path, default=Path("soak"))
    args = parser.parse_args()
    path = soak(args.env, args.minutes, args.out)
    plot(path)
    for name, value in slopes(path).items():
        print(f"{name:<34} {np.round(value, 3).tolist()}")


if __name__ == "__main__":
    main()
