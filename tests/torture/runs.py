"""Small trainings that are tortured, each a folder of ``train``; and what came of them."""

import contextlib
import csv
import io
import os
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_e2c.zoo import train

ROVERS, PREY = "MultiRover-6-3-v0", "PredatorPrey-v0"
SMALL = ["n_envs:2", "n_epochs:1", "batch_size:120", "policy_kwargs.net_arch:[8]"]
EPISODES = "env_kwargs.max_cycles:15"
TASKS = {
    ROVERS: ["--env", ROVERS, "-params", *SMALL, "n_steps:20", "cost_limits:0.1", EPISODES],
    PREY: ["--env", PREY, "-params", *SMALL, "n_steps:20", EPISODES, "normalize:True"],
}
SLOTS = {ROVERS: 2 * 6, PREY: 2 * 3}  # 2 worlds
CLOCKS = {"t", "time/fps", "time/time_elapsed"}


class Outcome(NamedTuple):
    """A line of the table.

    :param fault: What was done
    :param tried: How often
    :param lost: How often work was lost
    :param wrong: How often something else was wrong: a traceback, a hang, code executed
    """

    fault: str
    tried: int
    lost: int = 0
    wrong: int = 0
    notes: tuple[str, ...] = ()

    @property
    def survived(self):
        return self.tried - self.lost - self.wrong


def rollout(env):
    """Agent steps of a rollout."""
    return 20 * SLOTS[env]


def flags(folder, env=ROVERS, rollouts=5):
    """A command line of ``train`` that keeps a resume point after every rollout."""
    own = ["-n", str(rollouts * rollout(env)), "-f", str(folder), "--seed", "1", "--device", "cpu"]
    own += ["--eval-freq", str(2 * rollout(env)), "--eval-episodes", "2", "--verbose", "0"]
    own += ["--save-freq", str(3 * rollout(env)), "--resume-every", "0", "--algo", "e2c_t"]
    return [*own, *TASKS[env]]


def run_in(folder):
    """The folder of the run below a log folder; None if there is none yet."""
    found = list(Path(folder).glob("*/*_1/*/args.yml"))
    return found[0].parents[1] if found else None


def quietly(command, argv):
    """Run a command; its exit status, and what it wrote to stdout and stderr."""
    status, out, err = 0, _console("strict"), _console("backslashreplace")
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            command([str(word) for word in argv])
        except SystemExit as exit_:
            status = exit_.code
    return status, *(_text(each) for each in (out, err))


def _console(errors):
    """As strict about characters as Python's own."""
    return io.TextIOWrapper(io.BytesIO(), "utf-8", errors, write_through=True)


def _text(console):
    return console.buffer.getvalue().decode()


def fork(act, *args):
    """Call a function in a child process, which is never seen again.

    :return: Its process id; the exit status is 0, or 1 after an exception
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
        pid = os.fork()
    if pid == 0:
        status = 1
        try:
            act(*args)
            status = 0
        except SystemExit as exit_:
            status = exit_.code or 0
        except BaseException:
            traceback.print_exc()  # the table shows what it did not expect
        finally:
            os._exit(status if isinstance(status, int) else 1)
    return pid


def wait(pid):
    """The exit status of a child, negative for a signal."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def trained(folder, env=ROVERS, rollouts=5):
    """Train to the end.

    :return: The run's folder
    """
    with contextlib.redirect_stdout(io.StringIO()):  # RL-Zoo's heading
        return train.train(flags(folder, env, rollouts))


def results(run):
    """Everything in a run's folder that says what was learned, without the clock."""
    found = {path.name: weights(path) for path in sorted(run.glob("*.zip"))}
    found |= {name: rows(run / name) for name in ("monitor.csv", "progress.csv")}
    for path in sorted(run.glob("*.npz")):
        with np.load(path) as file:
            found[path.name] = {name: file[name].tolist() for name in file.files}
    return found


def weights(path):
    """All that a model file holds of networks, optimizers and multipliers, by name."""
    return dict(_tensors(load_from_zip_file(path, load_data=False, device="cpu")[1]))


def _tensors(tree, name=""):
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _tensors(value, f"{name}/{key}")
    elif isinstance(tree, th.Tensor):
        yield name, tree.tolist()


def rows(path):
    """Rows of a csv file without the clock."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in csv.DictReader(lines)]
