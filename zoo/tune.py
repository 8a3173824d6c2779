"""Search for hyperparameters: ``sb3-e2c tune --algo e2c_t --env KeepAway-v0 --n-trials 50``.

Every trial trains a team and evaluates it with sampled actions: the mean return is maximized, and
the limits on the mean costs are constraints. The first trial has the settings as they are. The same
command goes on with a study that was interrupted; several machines may work on one study.
"""

import argparse
import contextlib
import csv
import io
import math
import multiprocessing
import os
import shlex
import signal
import sys
import threading
import uuid
from collections.abc import Mapping, Sequence
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import optuna
import torch as th
import yaml
from filelock import FileLock, Timeout
from optuna.trial import FrozenTrial, TrialState

from sb3_e2c.vec_env import opponent_env
from sb3_e2c.zoo.build import build_model, own_callbacks
from sb3_e2c.zoo.configuration import ALGORITHMS, check_algo, check_env, parse_presets, preset_names
from sb3_e2c.zoo.console import (
    ConsoleParser,
    StoreDict,
    UserError,
    check_device,
    check_writable,
    one_line_errors,
    write_whole,
)
from sb3_e2c.zoo.experiment import configure
from sb3_e2c.zoo.objective import Objective, n_steps, worlds
from sb3_e2c.zoo.resume import Interrupted, stop_signals
from sb3_e2c.zoo.runs import check_seed
from sb3_e2c.zoo.search_space import SearchSpace
from sb3_e2c.zoo.signatures import schedule_start
from sb3_e2c.zoo.study import (
    COUNTED,
    PRUNERS,
    SAMPLERS,
    AmongAsSafe,
    SeededByTrial,
    create_study,
    default_name,
    ranked,
    study_folder,
    trial_in_words,
    violation,
)

_GRACE = 30.0  # seconds that a worker has to record its trial as failed


def make_parser() -> ConsoleParser:
    """The flags of ``tune``: RL-Zoo's names where it has them."""
    parser = ConsoleParser(
        prog="sb3-e2c tune",
        description=__doc__,
        examples=[
            "sb3-e2c tune --algo e2c_t --env KeepAway-v0 -n 300000 --n-trials 50 -j 4",
            "sb3-e2c tune --algo e2c_t --env KeepAway-v0 --show-space > space.yml  # for --space",
            "sb3-e2c train --algo e2c_t --env KeepAway-v0 --trial-id best  # with all its steps",
        ],
    )
    parser.set_defaults(resume="", trained_agent="")  # of train, whose configuration this is
    _add_task_flags(parser)
    _add_study_flags(parser)
    return parser


def _add_task_flags(parser: ConsoleParser) -> None:
    add = parser.add_argument
    pairs: dict[str, Any] = {"nargs": "+", "action": StoreDict, "metavar": "KEY:VALUE"}
    add("--algo", default="e2c_t", help=f"{', '.join(ALGORITHMS)} (default: e2c_t)")
    add("--env", default="MultiRover-6-3-v0", help="environment ID")
    add("-n", "--n-timesteps", type=int, default=-1, help="agent steps of a trial (default: all)")
    add("-f", "--log-folder", default="logs", help="results go to FOLDER/tune/STUDY")
    add("--seed", type=int, default=0, help="of the search; trial t trains with seed + t")
    add("--device", default="auto", help="torch device (default: auto)")
    add("--verbose", type=int, default=1, help="0: print nothing")
    names = ", ".join(preset_names())
    add("--preset", default="headline", metavar="NAME,NAME", help=f"named overrides: {names}")
    add("-conf", "--conf-file", help="YAML file of hyperparameters")
    add("-params", "--hyperparams", **pairs, help="hyperparameters that are not searched")
    add("--env-kwargs", **pairs, help="arguments of the environment")
    add("--space", type=Path, metavar="FILE", help="YAML file that changes what is searched")
    add("--show-space", action="store_true", help="print what would be searched, as such a file")


def _add_study_flags(parser: ConsoleParser) -> None:
    add = parser.add_argument
    add("--n-trials", type=int, default=50, help="trials of the study in all (default: 50)")
    add("-j", "--jobs", "--n-jobs", type=int, default=1, help="processes, one thread each")
    add(
        "--storage",
        metavar="URL|FILE",
        help="what several machines share: a journal file (also on NFS), or the URL of a database; "
        "sqlite:///FILE only on one machine (default: FOLDER/tune/STUDY/study.log, a journal)",
    )
    add("--study-name", metavar="STUDY", help="default: ALGO_ENV")
    add("--sampler", default="tpe", help=f"{', '.join(SAMPLERS)} (default: tpe)")
    add("--pruner", default="median", help=f"{', '.join(PRUNERS)} (default: median)")
    add("--n-startup-trials", type=int, default=10, help="random trials first, none pruned (10)")
    add("--n-evaluations", type=int, default=5, help="evaluations of a trial (default: 5)")
    add("--eval-episodes", type=int, default=50, help="episodes of an evaluation (default: 50)")
    add("--n-eval-envs", type=int, default=10, help="worlds for evaluation (default: 10)")


_AT_LEAST_1 = (
    *("n_trials", "jobs", "n_startup_trials", "n_evaluations", "eval_episodes", "n_eval_envs"),
)


def _check(args: argparse.Namespace) -> None:
    check_algo(args.algo)
    check_env(args.env)
    parse_presets(args.preset)
    for name in _AT_LEAST_1:
        if getattr(args, name) < 1:
            flag = f"--{name.replace('_', '-')}"
            raise UserError(f"{flag} is {getattr(args, name)}; expected at least 1")
    if args.n_timesteps != -1 and args.n_timesteps < 1:
        raise UserError(f"--n-timesteps is {args.n_timesteps}; expected at least 1")
    for name, known in (("sampler", SAMPLERS), ("pruner", PRUNERS)):
        if getattr(args, name) not in known:
            expected = ", ".join(known)
            raise UserError(f"--{name} is {getattr(args, name)!r}; expected one of {expected}")
    check_seed(args.seed)
    check_device(args.device)
    check_writable(args.log_folder, "--log-folder")


class Search:
    """A study and what this process does for it.

    :param args: The parsed flags
    """

    def __init__(self, args: argparse.Namespace):
        self.args = args
        config = configure(args)
        self.space = SearchSpace(args.algo, config, args.hyperparams, args.space)
        self._rehearse(config)
        self.name = args.study_name or default_name(args.algo, args.env)
        self.folder = study_folder(args.log_folder, self.name)
        self.worker = uuid.uuid4().hex
        limits = self._model_limits
        self.settings = {
            **{"algo": args.algo, "env": args.env, "limits": limits, "space": self.space.plain()},
            **{"n_timesteps": n_steps(args, config), "config": self.space.config},
            **{"n_evaluations": args.n_evaluations, "eval_episodes": args.eval_episodes},
        }

    def _rehearse(self, config: Mapping[str, Any]) -> None:
        """Build everything once, so that mistakes show before the study; hold opponents."""
        own_callbacks(config)
        with worlds(self.args.env, config, config["n_envs"], 0) as env:
            if opponent_env(env) is not None:
                self.space.hold_opponents()
            model = build_model(self.args.algo, self.space.config, env, device=self.args.device)
            self._model_limits = [float(limit) for limit in model.cost_limits]

    def open(self) -> optuna.Study:
        """The study, with this process' sampler and pruner."""
        args = self.args
        self.folder.mkdir(parents=True, exist_ok=True)
        study = create_study(args.storage, self.name, args.log_folder, self.settings)
        make = partial(_make_sampler, args.sampler, args.n_startup_trials)
        study.sampler = SeededByTrial(make, args.seed)
        make_pruner = PRUNERS[args.pruner]
        study.pruner = AmongAsSafe(make_pruner(args.n_startup_trials, args.n_evaluations))
        return study

    def missing(self, study: optuna.Study) -> int:
        """How many trials have to be started.

        :param study: The study
        """
        return self.args.n_trials - len(study.get_trials(deepcopy=False, states=COUNTED))

    def prepare(self, study: optuna.Study) -> None:
        """Give up trials of processes that are gone, and start with the settings as they are.

        :param study: The study
        """
        for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if self._is_lost(trial):
                study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
        if not study.get_trials(deepcopy=False, states=(*COUNTED, TrialState.WAITING)):
            study.enqueue_trial(self.space.start())

    def _lock(self, worker: str) -> Path:
        return self.folder / "workers" / f"{worker}.lock"

    def _is_lost(self, trial: FrozenTrial) -> bool:
        """Whether a process that worked on it has left its lock behind."""
        path = self._lock(trial.user_attrs.get("worker", "none"))
        if not path.is_file():
            return False
        try:
            with FileLock(path, timeout=0):
                return True
        except Timeout:
            return False

    def work(self, study: optuna.Study) -> None:
        """Do trials until the study has as many as it shall have.

        :param study: The study
        """
        th.set_num_threads(1)
        path = self._lock(self.worker)
        path.parent.mkdir(parents=True, exist_ok=True)
        objective = Objective(self.args, self.space, self.worker)
        try:
            with FileLock(path):
                while self.missing(study) > 0:
                    study.optimize(objective, 1, gc_after_trial=True, callbacks=[self._after_trial])
        finally:
            path.unlink(missing_ok=True)

    def _after_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        if self.args.verbose > 0:
            seconds = trial.duration.total_seconds() if trial.duration else 0.0
            print(f"{trial_in_words(trial, self._model_limits)} ({seconds:.0f} s)", flush=True)
        self.write(study)
        if trial.state is TrialState.FAIL:  # else it would be done again for ever
            raise UserError(f"trial {trial.number} ended without a number for its return")

    def write(self, study: optuna.Study) -> None:
        """Write trials.csv, and best.yml if there is a best trial.

        :param study: The study
        """
        trials = study.get_trials(deepcopy=False)
        write_whole(self.folder / "trials.csv", table_of(trials, list(self.settings["space"])))
        complete = ranked(trials)
        if complete:
            write_whole(self.folder / "best.yml", self._best_file(complete[0]))

    def _best_file(self, best: FrozenTrial) -> str:
        """For ``train --conf-file``."""
        args = self.args
        config = best.user_attrs["config"]
        lines = [
            f"# Study {self.name}, {trial_in_words(best, self._model_limits)}",
            f"# sb3-e2c train --algo {args.algo} --env {args.env} --conf-file "
            f"{shlex.quote(str(self.folder / 'best.yml'))}",
        ]
        return "\n".join([*lines, yaml.safe_dump({args.env: config})])

    def report(self, study: optuna.Study) -> str:
        """The ten best trials, and what the best one tried.

        :param study: The study
        """
        trials = study.get_trials(deepcopy=False)
        complete = ranked(trials)
        if not complete:
            return f"No complete trial yet; see {self.folder / 'trials.csv'}"
        lines = [trial_in_words(trial, self._model_limits) for trial in complete[:10]]
        best = complete[0]
        lines += ["", f"Best of {len(complete)} complete trials: {best.number}"]
        if violation(best) > 0:
            lines.append("No trial keeps all limits: this one exceeds them least")
        config = best.user_attrs["config"]
        for key in self.settings["space"]:
            was, now = self.space.current(key), value_at(config, key)
            changed = (schedule_start(now) or now) != was
            lines.append(f"  {key}: {now}" + (f"  (was {was})" if changed else ""))
        lines += [f"Written: {self.folder / 'best.yml'}, {self.folder / 'trials.csv'}"]
        return "\n".join([*lines, f"Train it: {self._train_command()}"])

    def _train_command(self) -> str:
        args = self.args
        words = ["sb3-e2c", "train", "--algo", args.algo, "--env", args.env, "--trial-id", "best"]
        words += ["--study-name", self.name] if args.study_name else []
        words += ["--storage", args.storage] if args.storage else []
        words += ["-f", args.log_folder] if args.log_folder != "logs" else []
        return shlex.join(words)


def _make_sampler(name: str, n_startup_trials: int, seed: int) -> optuna.samplers.BaseSampler:
    return SAMPLERS[name](seed, n_startup_trials)


def value_at(config: Mapping[str, Any], key: str) -> Any:
    """A value in a configuration; None if it is not given.

    :param config: The configuration
    :param key: A dotted key
    """
    value: Any = config
    for name in key.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def table_of(trials: Sequence[FrozenTrial], keys: Sequence[str]) -> str:
    """All trials as CSV.

    :param trials: Trials
    :param keys: The hyperparameters that are searched
    """
    n_costs = max((len(trial.user_attrs.get("costs", [])) for trial in trials), default=0)
    costs = [f"cost_{j}" for j in range(n_costs)] if n_costs > 1 else ["cost"][:n_costs]
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    head = ["trial", "state", "return", "return_se", *costs, "violation", "seconds"]
    rows.writerow([*head, *keys, "error"])
    for trial in trials:
        attrs = trial.user_attrs
        found = attrs.get("costs", [math.nan] * n_costs)
        seconds = trial.duration.total_seconds() if trial.duration else math.nan
        numbers = [attrs.get("return", math.nan), attrs.get("return_se", math.nan), *found]
        numbers += [violation(trial) if "costs" in attrs else math.nan, round(seconds, 1)]
        tried = [value_at(attrs.get("config", {}), key) for key in keys]
        state = trial.state.name.lower()
        rows.writerow([trial.number, state, *numbers, *tried, attrs.get("error", "")])
    return text.getvalue()


# ---------------------------------------------------------------------------------- processes


def _work_in_process(args: argparse.Namespace) -> None:
    """What a worker process does."""
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C reaches it through its parent only
    _end_with_parent()
    with contextlib.suppress(KeyboardInterrupt), one_line_errors(), stop_signals():
        search = Search(args)
        search.work(search.open())


def _end_with_parent() -> None:
    """Ask this process to stop as soon as its parent is gone, however that came about."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


def _work_in_parallel(args: argparse.Namespace, n_processes: int) -> None:
    """Several processes; each looks into the study for what is left to do."""
    spawn = multiprocessing.get_context("spawn")
    processes = [spawn.Process(target=_work_in_process, args=(args,)) for _ in range(n_processes)]
    try:
        for process in processes:
            process.start()
        for process in processes:
            process.join()
    finally:
        _stop([process for process in processes if process.pid is not None])
    if any(process.exitcode for process in processes):
        raise UserError("a worker process failed; its message stands above")


def _stop(processes: Sequence[BaseProcess]) -> None:
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_GRACE)
        process.kill()
        process.join()


def tune(args: argparse.Namespace) -> optuna.Study:
    """Search as a command line asks.

    :param args: See :func:`make_parser`
    :return: The study
    :raises UserError: for mistakes, and if no training came to its end
    :raises KeyboardInterrupt: if Ctrl-C or SIGTERM stopped it; the same flags go on
    """
    search = Search(args)
    study = search.open()
    search.prepare(study)
    n_processes = min(args.jobs, search.missing(study))
    try:
        if n_processes > 1:
            _work_in_parallel(args, n_processes)
        elif n_processes == 1:
            search.work(study)
    finally:
        search.write(study)
        if args.verbose > 0:
            print(search.report(study))
    errors = [t.user_attrs["error"] for t in study.get_trials(False) if "error" in t.user_attrs]
    if errors and not ranked(study.get_trials(deepcopy=False)):
        raise UserError(f"no trial came to its end; the last broke off: {errors[-1]}")
    return study


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c tune``.

    :param argv: Flags; default: those of this process
    """
    argv = sys.argv[1:] if argv is None else argv
    args = make_parser().parse_args(argv)
    with one_line_errors():
        _check(args)
        if args.show_space:
            space = SearchSpace(args.algo, configure(args), args.hyperparams, args.space)
            print(yaml.safe_dump(space.plain(), sort_keys=False, default_flow_style=None), end="")
            return
        try:
            with stop_signals():
                tune(args)
        except KeyboardInterrupt as stop:
            print(f"Interrupted; go on with: {shlex.join(['sb3-e2c', 'tune', *argv])}")
            raise Interrupted(getattr(stop, "number", signal.SIGINT)) from None


if __name__ == "__main__":
    main()
