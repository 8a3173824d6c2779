"""Train a team: ``python -m sb3_e2c.zoo.train --algo e2c_t --env MultiRover-6-3-v0``.

RL-Zoo's ``train`` with our algorithms, environments and manager, ``--preset`` and ``--resume``, and
mistakes reported in one line before anything is written. All steps are agent steps; ``n_envs`` in
the hyperparameters counts worlds.
"""

import argparse
import contextlib
import importlib
import importlib.util
import signal
import sys
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import rl_zoo3.train

from sb3_e2c.zoo.configuration import (
    ALGORITHMS,
    check_algo,
    check_env,
    parse_presets,
    preset_names,
    read_yaml,
)
from sb3_e2c.zoo.console import (
    ConsoleParser,
    StoreDict,
    UserError,
    check_device,
    check_writable,
    one_line_errors,
)
from sb3_e2c.zoo.experiment import TeamExperimentManager, configure, register
from sb3_e2c.zoo.resume import (
    Interrupted,
    NothingToDo,
    how_to_go_on,
    resumed_arguments,
    stop_signals,
)
from sb3_e2c.zoo.study import trial_arguments

_PAIRS = {"action": StoreDict, "metavar": "KEY:VALUE"}
# RL-Zoo's flags that mean something else here, or read their values as data instead of code
_CHANGED_FLAGS: dict[str, dict[str, Any]] = {
    "--algo": {
        "default": "e2c_t",
        "choices": None,
        "metavar": "ALGO",
        "help": f"{', '.join(ALGORITHMS)} (default: e2c_t)",
    },
    "--env": {"default": "MultiRover-6-3-v0", "help": "environment ID (see sb3_e2c.envs.ENV_IDS)"},
    "--num-threads": {  # small networks: one thread is faster, and results do not depend on cores
        "default": 1,
        "help": "Number of threads for PyTorch (default: 1; -1: PyTorch's own choice)",
    },
    "--vec-env": {"help": "subproc: worlds run in worker processes (SuperSuit), else in this one"},
    "--eval-freq": {"help": "Evaluate the team every n agent steps (if negative, no evaluation)"},
    "--save-freq": {"help": "Save the team every n agent steps (if negative, no checkpoint)"},
    "--eval-episodes": {"help": "Number of world episodes to use for evaluation"},
    "--n-eval-envs": {"help": "Number of worlds for evaluation"},
    "--trained-agent": {"help": "Continue training this .zip, from which only numbers are read"},
    "--conf-file": {"help": "YAML file of hyperparameters, by environment ID or 'default'"},
    "--hyperparams": {
        **_PAIRS,
        "help": "Overwrite hyperparameters (e.g. n_epochs:4 oem_kwargs.psi:0.1)",
    },
    "--env-kwargs": _PAIRS,
    "--eval-env-kwargs": _PAIRS,
    "--trial-id": {
        "type": str,
        "metavar": "TRIAL|best",
        "help": "Train with the hyperparameters of a trial of sb3-e2c tune",
    },
    "--study-name": {"help": "The study of --trial-id (default: ALGO_ENV)"},
    "--storage": {"help": "Where that study is stored (default: its journal in the log folder)"},
}
# RL-Zoo's search for hyperparameters is a command of its own here.
_OF_TUNE = {
    *("--n-trials", "--max-total-trials", "--sampler", "--pruner", "--n-jobs"),
    *("--n-startup-trials", "--n-evaluations", "--no-optim-plots"),
    *("--optimization-log-path", "--optimize-hyperparameters"),
}
_NOT_FOR_TEAMS = {*_OF_TUNE, "--save-replay-buffer", "--truncate-last-trajectory"}
_MOST_THREADS = 1024  # torch would start them all
_AT_LEAST = {
    "eval_episodes": 1,
    "n_eval_envs": 1,
    "log_interval": -2,
    "verbose": 0,
}


class TrainParser(ConsoleParser):
    """The parser that RL-Zoo's ``train`` fills, with our flags and checks.

    :param argv: The command line after the program's name
    """

    def __init__(self, argv: Sequence[str]):
        super().__init__(
            prog="sb3-e2c train",
            description=__doc__,
            examples=[
                "sb3-e2c train --algo e2c_t --env MultiRover-6-3-v0 --seed 1 -f logs -P",
                "sb3-e2c train --algo e2c --env PredatorPrey-v0 --preset gru,lambda_1 -tb tb",
                "sb3-e2c train --env MultiRover-8-4-v0 -params n_epochs:4 oem_kwargs.psi:0.1",
                "sb3-e2c train --resume logs/e2c_t/MultiRover-6-3-v0_1",
                "sb3-e2c train --env KeepAway-v0 --trial-id best  # after sb3-e2c tune",
            ],
        )
        self.argv = argv

    def add_argument(self, *names: str, **kwargs: Any) -> Any:
        """Add a flag of RL-Zoo's, changed where ours differ."""
        for name in names:
            kwargs.update(_CHANGED_FLAGS.get(name, {}))
        if _NOT_FOR_TEAMS.intersection(names):
            kwargs = {"action": _Refuse, "nargs": "*", "default": kwargs.get("default")}
            kwargs["help"] = argparse.SUPPRESS
        return super().add_argument(*names, **kwargs)

    def parse_args(self, *_: Any, **__: Any) -> Any:
        """Parse and check the command line; exits with status 2 and one line on a mistake."""
        self.add_argument(
            "--preset",
            default="headline",
            metavar="NAME,NAME",
            help=f"Named overrides, to be combined: {', '.join(preset_names())}",
        )
        self.add_argument(
            "--opponent",
            default="own",
            metavar="own|random|FILE",
            help="Who plays against the team, where somebody does: an adversary that learns, too "
            "(own, the default), random actions, or a saved adversary that learns no more",
        )
        self.add_argument(
            "--resume",
            default="",
            metavar="RUN",
            help="Go on with an interrupted run, for instance logs/e2c_t/MultiRover-6-3-v0_1, with "
            "its own settings (-n may be another total); worlds in a batched simulator give the "
            "same result as without the interruption. Your own runs only: it unpickles their state",
        )
        self.add_argument(
            "--resume-every",
            type=float,
            default=60.0,
            metavar="SECONDS",
            help="How often to write a resume point to the disk, at the end of a rollout "
            "(default: 60; 0: always). A stopped run writes its latest in any case",
        )
        self.add_argument(
            "--trust",
            action="store_true",
            help="Let a file execute what its author has put there: -i loads it as "
            "Stable-Baselines3 does, by unpickling, with the callback in its config.yml; --resume "
            "also takes a run that sb3-e2c load has fetched",
        )
        defaults = vars(super().parse_args([]))
        unset = object()
        typed = super().parse_args(self.argv, argparse.Namespace(**dict.fromkeys(defaults, unset)))
        given = {name: value for name, value in vars(typed).items() if value is not unset}
        with one_line_errors():
            args = argparse.Namespace(**defaults | given)
            if "resume" in given:
                flags = {each.dest: each.option_strings[-1] for each in self._actions}
                args = resumed_arguments(Path(args.resume), given, defaults, flags)
            elif given.keys() & {"trial_id", "study_name", "storage"}:
                args = trial_arguments(given, defaults)
            _check(args)
        return args


class _Refuse(argparse.Action):
    """A flag of RL-Zoo's that would do nothing."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Report the flag as a mistake."""
        flags = "/".join(self.option_strings)
        searches = _OF_TUNE.intersection(self.option_strings)
        why = "search with sb3-e2c tune" if searches else "they have no replay buffer"
        parser.error(f"{flags} is not available for teams: {why}")


def _check(args: argparse.Namespace) -> None:
    """Refuse what cannot be meant, before anything is built or written."""
    _check_own(args)
    _import_packages(args.gym_packages)
    register()
    check_algo(args.algo)
    check_env(args.env)
    parse_presets(args.preset)
    _check_numbers(args)
    check_device(args.device)
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UserError("--track needs Weights & Biases: pip install wandb")
    check_writable(args.log_folder, "--log-folder")
    if args.tensorboard_log:  # "" is RL-Zoo's word for none
        check_writable(args.tensorboard_log, "--tensorboard-log")
    if args.trained_agent and not zipfile.is_zipfile(args.trained_agent):
        raise UserError(f"-i {args.trained_agent}: expected the .zip file of a saved model")
    if args.opponent not in ("own", "random") and not zipfile.is_zipfile(args.opponent):
        raise UserError(
            f"--opponent is {args.opponent}; expected own, random, or the .zip file of an adversary"
        )
    configure(args)


def _check_own(args: argparse.Namespace) -> None:
    """Refuse to unpickle what ``load`` has fetched, unless its author is trusted."""
    saved = Path(args.resume, args.env, "args.yml")
    if args.resume and not args.trust and saved.is_file() and "repo_id" in read_yaml(saved):
        raise UserError(
            f"--resume: {args.resume} was fetched from the hub, and to resume it is to unpickle "
            "it, which can execute what its author has put there; say --trust if you want that"
        )


def _import_packages(names: Sequence[str]) -> None:
    for name in names:
        try:
            importlib.import_module(name)
        except (ImportError, TypeError, ValueError) as error:  # also for a name that is none
            raise UserError(f"--gym-packages {name!r}: {error}") from error


def _check_numbers(args: argparse.Namespace) -> None:
    for name, least in _AT_LEAST.items():
        if getattr(args, name) < least:
            flag = f"--{name.replace('_', '-')}"
            raise UserError(f"{flag} is {getattr(args, name)}; expected at least {least}")
    if args.num_threads > _MOST_THREADS:
        raise UserError(f"--num-threads is {args.num_threads}; expected at most {_MOST_THREADS}")
    if args.n_timesteps != -1 and args.n_timesteps < 1:
        raise UserError(f"--n-timesteps is {args.n_timesteps}; expected at least 1")
    if not args.resume_every >= 0:
        raise UserError(f"--resume-every is {args.resume_every}; expected at least 0 seconds")
    if args.seed >= 2**32:
        raise UserError(f"--seed is {args.seed}; expected less than 2**32")
    if args.log_interval == 0:
        raise UserError("--log-interval is 0; expected at least 1 (or -1: default, -2: none)")


@contextlib.contextmanager
def _our_zoo(argv: Sequence[str]) -> Iterator[list[TeamExperimentManager]]:
    """RL-Zoo's train module with our parser and manager; yields the managers that it makes."""
    managers: list[TeamExperimentManager] = []
    command = ["python", "-m", "sb3_e2c.zoo.train", *argv]

    def make_manager(*args: Any, **kwargs: Any) -> TeamExperimentManager:
        managers.append(TeamExperimentManager(*args, command=command, **kwargs))
        return managers[-1]

    ours = {
        "argparse": SimpleNamespace(ArgumentParser=lambda: TrainParser(argv)),
        "ExperimentManager": make_manager,
    }
    stock = {name: getattr(rl_zoo3.train, name) for name in ours}
    vars(rl_zoo3.train).update(ours)
    try:
        yield managers
    finally:
        vars(rl_zoo3.train).update(stock)


def train(argv: Sequence[str]) -> Path:
    """Train as a command line asks.

    :param argv: Flags, as after ``sb3-e2c train``
    :return: The folder of the run
    :raises UserError: for mistakes that only show when the run is built
    :raises Interrupted: (a ``SystemExit``) if Ctrl-C or SIGTERM stopped it; what it had learned is
        saved, and ``--resume`` goes on
    """
    with stop_signals(), _our_zoo(argv) as managers:
        try:
            rl_zoo3.train.train()
        except NothingToDo as news:
            print(news)
        except KeyboardInterrupt as stop:  # before or after the training itself
            print(f"Interrupted ({stop})", file=sys.stderr)
            raise Interrupted(getattr(stop, "number", signal.SIGINT)) from None
        finally:
            for manager in managers:
                manager.points.close()
    manager = managers[-1]
    if manager.stopped_by is not None:
        if manager.points.latest is not None:
            print(f"Go on with: {how_to_go_on(Path(manager.save_path))}")
        raise Interrupted(manager.stopped_by)
    return Path(manager.save_path)


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c train``.

    :param argv: Flags; default: those of this process
    """
    with one_line_errors():
        train(sys.argv[1:] if argv is None else argv)


if __name__ == "__main__":
    main()
