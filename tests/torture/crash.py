"""Kills at random and at the worst moments; disks that are full, read-only or gone."""

import contextlib
import ctypes
import errno
import io
import os
import random
import resource
import shutil
import signal
import tempfile
import time
from pathlib import Path

import numpy as np

from sb3_e2c.zoo import train
from sb3_e2c.zoo.resume import KeepPoints, newest_point
from torture.runs import (
    ROVERS,
    Outcome,
    flags,
    fork,
    quietly,
    results,
    run_in,
    trained,
    wait,
    weights,
)

# ---------------------------------------------------------------------------- faults


class Fault:
    """Happens at the n-th time that a process touches the disk: on opening, in the middle of
    writing, on flushing, on renaming, on removing.

    :param number: n
    :param happen: What happens; it dies or raises
    """

    def __init__(self, number, happen):
        self.left, self.happen = number, happen

    def install(self):
        """Put it into this process, for good."""
        for module, name in ((os, "fsync"), (os, "replace"), (os, "chmod"), (os, "unlink")):
            setattr(module, name, self.before(getattr(module, name)))
        tempfile.mkstemp = self.before(tempfile.mkstemp)
        real = os.fdopen
        os.fdopen = lambda handle, mode: _Halfway(real(handle, mode, buffering=0), self)

    def before(self, act):
        def acting(*args, **kwargs):
            self.count()
            result = act(*args, **kwargs)
            self.count()
            return result

        return acting

    def count(self):
        self.left -= 1
        if self.left == 0:
            self.happen()


class _Halfway(io.BufferedWriter):
    """A file that a fault may find half-written."""

    def __init__(self, file, fault):
        super().__init__(file)
        self.fault = fault

    def write(self, content):
        half = len(content) // 2
        super().write(memoryview(content)[:half])
        self.flush()
        self.fault.count()
        return half + super().write(memoryview(content)[half:])


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def disk_says(number):
    """A fault that stays: whoever writes later is refused, too."""

    def happen():
        def refuse(*_, **__):
            raise OSError(number, os.strerror(number))

        for name in ("fsync", "replace"):
            setattr(os, name, refuse)
        tempfile.mkstemp = refuse
        refuse()

    return happen


# ---------------------------------------------------------------------------- kills


def train_with(fault, argv):
    """Train in a child process in which a fault happens."""

    def act():
        fault.install()
        quietly(train.main, argv)

    return fork(act)


def kill_at_random(argv, rng):
    """Train, and kill it from outside."""
    pid = fork(quietly, train.main, argv)
    time.sleep(rng.uniform(0.1, 1.5))
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    return wait(pid)


def kill_while_writing(argv, rng):
    """Train, and let it kill itself around or in the middle of a write."""
    return wait(train_with(Fault(rng.randint(1, 150), die), argv))


KILLS = {
    "kill -9 at a random moment": kill_at_random,
    "kill -9 while a file is written": kill_while_writing,
}


def next_command(folder, env, rollouts):
    """How to go on after a kill; anew only if training had not begun."""
    run = run_in(folder)
    if run is None or newest_point(run) is None:
        shutil.rmtree(folder, ignore_errors=True)
        return flags(folder, env, rollouts)
    return ["--resume", str(run)]


def inspect(folder):
    """Read everything that a killed run has left; raises if something is not whole.

    :return: Agent steps of its newest resume point, 0 if there is none yet
    """
    run = run_in(folder)
    if run is None:
        return 0
    for path in run.glob("[!.]*.zip"):
        weights(path)
    for path in run.glob("[!.]*.npz"):
        with np.load(path) as file:
            dict(file)
    points = sorted((run / "resume").glob("[!.]*.point"))
    status, out, _ = quietly(lambda _: newest_point(run), [])
    assert status == 0
    assert "damaged" not in out
    return int(points[-1].stem) if points else 0


def kills(folder, kill, n, env=ROVERS, rollouts=30, seed=0):
    """Kill a training again and again, each time going on from its newest resume point.

    :param n: How many kills at least; trainings begin anew until there were so many
    :return: Kills, lost, wrong, notes
    """
    rng = random.Random(seed)
    tried, lost, notes = 0, 0, []
    reference = results(trained(folder / "straight", env, rollouts))
    while tried < n:
        shutil.rmtree(folder / "killed", ignore_errors=True)
        steps, expected = 0, None
        while expected is None:
            argv = next_command(folder / "killed", env, rollouts)
            finish = tried >= n
            status = wait(fork(quietly, train.main, argv)) if finish else kill(argv, rng)
            if status == -signal.SIGKILL:
                tried += 1
            elif status == 0:
                expected = reference
            else:
                return tried, lost, 1, [*notes, f"status {status} after {argv}"]
            try:
                before, steps = steps, inspect(folder / "killed")
            except Exception as error:  # whatever half a file makes its reader raise
                return tried, lost + 1, 0, [*notes, f"after a kill: {error}"]
            lost += steps < before
        if results(run_in(folder / "killed")) != reference:
            return tried, lost, 1, [*notes, "the end differs from the uninterrupted run's"]
    return tried, lost, 0, notes


# ---------------------------------------------------------------------------- disks


def refused_then_resumed(folder, make_trouble, reference, env=ROVERS, rollouts=5):
    """Train on a disk that refuses from some moment on, then go on with a good one.

    :param make_trouble: Called in the child process
    :return: None, or what is wrong
    """
    argv = flags(folder, env, rollouts)
    message = folder.with_suffix(".stderr")

    def act():
        make_trouble()
        status, _, error = quietly(train.main, argv)
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        message.write_text(error)
        raise SystemExit(status)

    status, error = wait(fork(act)), message.read_text() if message.exists() else ""
    if status == 0:  # the fault came too late
        return None if results(run_in(folder)) == reference else "the end differs"
    if status != 2 or len(error.strip().splitlines()) != 1:
        return f"status {status}: {error.strip()[-300:]}"
    inspect(folder)
    status, _, error = quietly(train.main, next_command(folder, env, rollouts))
    if status != 0:
        return f"cannot go on: {error}"
    return None if results(run_in(folder)) == reference else "the end differs"


def disks(folder, n, seed=0):
    """Full and failing disks: an error number at a random write, and a limit on files' sizes."""
    rng, reference = random.Random(seed), results(trained(folder / "straight"))
    for number in (errno.ENOSPC, errno.EROFS, errno.EIO, errno.EDQUOT):
        fault = f"disk: {os.strerror(number)}"
        notes = []
        for _ in range(n):
            trouble = Fault(rng.randint(1, 300), disk_says(number)).install
            notes += _note(folder / "run", trouble, reference)
        yield Outcome(fault, n, wrong=len(notes), notes=tuple(notes))
    notes = []
    for _ in range(n):
        size = rng.randint(100, 60_000)
        notes += _note(folder / "run", lambda s=size: limit_files(s), reference)
    yield Outcome("disk: files may not grow", n, wrong=len(notes), notes=tuple(notes))


def _note(folder, trouble, reference):
    shutil.rmtree(folder, ignore_errors=True)
    folder.with_suffix(".stderr").unlink(missing_ok=True)
    found = refused_then_resumed(folder, trouble, reference)
    return [] if found is None else [found]


def limit_files(size):
    """As a quota would."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))


def deleted(folder, how="delete", at=3):
    """Delete or rename the folder of a run that trains.

    :return: None, or what is wrong
    """

    def trouble():
        real, calls = KeepPoints._on_rollout_start, []

        def on_rollout_start(self):
            calls.append(0)
            if len(calls) == at:
                run = run_in(folder)
                shutil.rmtree(run) if how == "delete" else run.rename(folder / "elsewhere")
            real(self)

        KeepPoints._on_rollout_start = on_rollout_start

    message = folder / "stderr"
    folder.mkdir(parents=True)

    def act():
        trouble()
        status, _, error = quietly(train.main, flags(folder))
        message.write_text(error)
        raise SystemExit(status)

    status, error = wait(fork(act)), message.read_text()
    if status != 2 or len(error.strip().splitlines()) != 1 or "deleted or renamed" not in error:
        return f"{how}: status {status}: {error.strip()[-300:]}"
    if how == "rename":
        assert newest_point(folder / "elsewhere") is not None
    return None


_NEW_NAMESPACE, _READ_ONLY, _REMOUNT, _PRIVATE = 0x00020000, 1, 32, 1 << 18 | 1 << 14


def _own_mounts(libc):
    """What this process mounts from now on, no other sees."""
    if libc.unshare(_NEW_NAMESPACE) or libc.mount(b"none", b"/", None, _PRIVATE, None):
        raise SystemExit(77)


def tmpfs(folder, kib):
    """Train on a small disk of its own until it is full; enlarge it and go on.

    :return: None, or what is wrong; "skipped" where mounting is not permitted
    """
    libc = ctypes.CDLL(None, use_errno=True)
    folder.mkdir(parents=True)
    reference = results(trained(folder / "straight"))
    place = folder / "disk"
    place.mkdir()

    def mount(options, flags=0):
        args = (b"tmpfs", str(place).encode(), b"tmpfs", flags, options.encode())
        if libc.mount(*args) != 0:
            raise SystemExit(77)

    def act():
        if libc.unshare(_NEW_NAMESPACE) != 0 or libc.mount(
            b"none", b"/", None, 1 << 18 | 1 << 14, None
        ):
            raise SystemExit(77)
        mount(f"size={kib}k")
        status, _, error = quietly(train.main, flags(place / "logs"))
        if status != 2 or len(error.strip().splitlines()) != 1:
            raise SystemExit(3)
        inspect(place / "logs")
        mount("size=100m", _REMOUNT)
        quietly(train.main, next_command(place / "logs", ROVERS, 5))
        raise SystemExit(0 if results(run_in(place / "logs")) == reference else 4)

    status = wait(fork(act))
    return {0: None, 77: "skipped", 3: "no clear error", 4: "the end differs"}.get(status, status)


def read_only(folder):
    """A log folder on a disk that is mounted read-only.

    :return: As :func:`tmpfs`
    """
    libc = ctypes.CDLL(None, use_errno=True)
    folder.mkdir(parents=True)

    def act():
        if libc.unshare(_NEW_NAMESPACE) != 0 or libc.mount(
            b"none", b"/", None, 1 << 18 | 1 << 14, None
        ):
            raise SystemExit(77)
        if libc.mount(b"tmpfs", str(folder).encode(), b"tmpfs", _READ_ONLY, b"size=1m") != 0:
            raise SystemExit(77)
        status, _, error = quietly(train.main, flags(folder / "logs"))
        raise SystemExit(0 if status == 2 and "cannot write there" in error else 3)

    return {0: None, 77: "skipped"}.get(wait(fork(act)), "no clear error")


def torture(folder, n_kills=100, n_disks=20):
    """Everything, as lines of the table.

    :param folder: An empty folder
    """
    for fault, kill in KILLS.items():
        place = Path(tempfile.mkdtemp(dir=folder))
        tried, lost, wrong, notes = kills(place, kill, n_kills // 2)
        yield Outcome(fault, tried, lost, wrong, tuple(notes))
    yield from disks(Path(tempfile.mkdtemp(dir=folder)), n_disks)
    others = {
        "the run's folder is deleted": lambda f: deleted(f, "delete"),
        "the run's folder is renamed": lambda f: deleted(f, "rename"),
        "a disk of 400 KiB": lambda f: tmpfs(f, 400),
        "a disk of 100 KiB": lambda f: tmpfs(f, 100),
        "a disk that is mounted read-only": read_only,
    }
    for number, (fault, trial) in enumerate(others.items()):
        found = trial(folder / f"other_{number}")
        if found != "skipped":
            yield Outcome(fault, 1, wrong=int(found is not None), notes=(found,) if found else ())
