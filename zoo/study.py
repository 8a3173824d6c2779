"""A study of ``sb3-e2c tune``: where it is stored, which trials it has, and which is the best.

Limits are Optuna's constraints, mean cost − limit, so that its samplers and dashboards know them.
"""

import json
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import optuna
from optuna.distributions import BaseDistribution
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, GPSampler, NSGAIISampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.pool import NullPool

from sb3_e2c.zoo.configuration import check_algo, check_env, merge
from sb3_e2c.zoo.console import UserError, brief

optuna.logging.set_verbosity(optuna.logging.ERROR)  # we report every trial ourselves

SAMPLERS: dict[str, Callable[[int, int], BaseSampler]] = {
    "tpe": lambda seed, start: TPESampler(n_startup_trials=start, seed=seed, multivariate=True),
    "gp": lambda seed, start: GPSampler(n_startup_trials=start, seed=seed),
    "nsgaii": lambda seed, start: NSGAIISampler(population_size=max(start, 2), seed=seed),
    "random": lambda seed, _: RandomSampler(seed=seed),
}
PRUNERS: dict[str, Callable[[int, int], BasePruner]] = {
    "median": lambda start, n: MedianPruner(n_startup_trials=start, n_warmup_steps=n // 3),
    "halving": lambda *_: SuccessiveHalvingPruner(min_resource=1),
    "none": lambda *_: NopPruner(),
}
COUNTED = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
DIVERGED = 1e9  # the constraint of a trial that broke off: worse than any violation of a limit


class SeededByTrial(BaseSampler):
    """A sampler whose random numbers follow from the trial's number.

    So several processes and machines with the same seed never try the same, and a study that was
    interrupted goes on as it would have.

    :param make: Makes a sampler from a seed
    :param seed: Trial t gets seed + t
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int):
        self.make, self.seed = make, seed
        self.sampler = make(seed)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Make the trial's sampler."""
        self.sampler = self.make(self.seed + trial.number)
        self.sampler.before_trial(study, trial)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """See Optuna."""
        return self.sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """See Optuna."""
        return self.sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """See Optuna."""
        return self.sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
    ) -> None:
        """See Optuna."""
        self.sampler.after_trial(study, trial, state, values)


class AmongAsSafe(BasePruner):
    """A pruner that compares a trial only with those that violate the limits no more than it does.

    Optuna's pruners see returns alone, and would stop the trials that keep the limits in favour of
    those that earn more by exceeding them. Without limits this is the pruner itself.

    :param pruner: One of Optuna's
    """

    def __init__(self, pruner: BasePruner):
        self.pruner = pruner

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """See Optuna."""
        return self.pruner.prune(cast(optuna.Study, _Peers(study, trial)), trial)


class _Peers:
    """A study in which a pruner sees nobody who takes more risks than the trial at this step."""

    def __init__(self, study: optuna.Study, trial: FrozenTrial):
        self.study, self.key = study, violation_key(trial.last_step)
        self.most = trial.user_attrs.get(self.key, 0.0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.study, name)

    def get_trials(self, *args: Any, **kwargs: Any) -> list[FrozenTrial]:
        """See Optuna."""
        trials = self.study.get_trials(*args, **kwargs)
        return [t for t in trials if t.user_attrs.get(self.key, 0.0) <= self.most]


def violation_key(step: int | None) -> str:
    """Name of the attribute with the violation at an evaluation.

    :param step: Number of the evaluation
    """
    return f"violation at {step}"


def default_name(algo: str, env_id: str) -> str:
    """A study's name if none was given.

    :param algo: A key of ``ALGORITHMS``
    :param env_id: A key of ``ENV_IDS``
    """
    return f"{algo}_{env_id}"


def study_folder(log_folder: str | Path, name: str) -> Path:
    """Where a study's results lie.

    :param log_folder: What ``-f`` says
    :param name: The study's name
    """
    return Path(log_folder) / "tune" / name.replace("/", "_")


def open_storage(storage: str | None, folder: Path) -> BaseStorage:
    """A storage that several processes can share.

    :param storage: A database URL, or a journal file; None: a journal file in the study's folder
    :param folder: The study's folder
    :raises UserError: if it cannot be opened
    """
    text = str(folder / "study.log") if storage is None else storage
    if "://" not in text and Path(text).suffix in (".db", ".sqlite", ".sqlite3"):
        raise UserError(f"--storage {text}: expected sqlite:///{text} (a database) or a .log file")
    try:
        if "://" in text:
            return RDBStorage(text, engine_kwargs=_engine_kwargs(text))
        Path(text).parent.mkdir(parents=True, exist_ok=True)
        return JournalStorage(JournalFileBackend(text))
    except Exception as error:  # drivers that are missing, servers that refuse, foreign files
        raise UserError(f"--storage {text}: {brief(error)}") from error


def _engine_kwargs(url: str) -> dict[str, Any]:
    """SQLite gives up after 5 seconds if others are writing, and nobody would close a pool."""
    if not url.startswith("sqlite"):
        return {}
    return {"connect_args": {"timeout": 60}, "poolclass": NullPool}


def load_study(storage: str | None, name: str, log_folder: str | Path) -> optuna.Study:
    """A study that exists.

    :param storage: See :func:`open_storage`
    :param name: Its name
    :param log_folder: Where its folder lies
    :raises UserError: if there is none
    """
    folder = study_folder(log_folder, name)
    place = storage or str(folder / "study.log")
    missing = UserError(
        f"there is no study {name} in {place}; name it with --study-name, --storage"
    )
    is_file = "://" not in place or place.startswith("sqlite:///")
    if is_file and not Path(place.removeprefix("sqlite:///")).is_file():
        raise missing
    try:
        return optuna.load_study(study_name=name, storage=open_storage(storage, folder))
    except KeyError:
        raise missing from None


def create_study(
    storage: str | None, name: str, log_folder: str | Path, settings: Mapping[str, Any]
) -> optuna.Study:
    """A new study, or the one of this name if it was started with the same settings.

    :param storage: See :func:`open_storage`
    :param name: Its name
    :param log_folder: Where its folder lies
    :param settings: What makes the trials of a study comparable
    :raises UserError: if they differ
    """
    study = optuna.create_study(
        storage=open_storage(storage, study_folder(log_folder, name)),
        study_name=name,
        direction="maximize",
        load_if_exists=True,
    )
    asked = json.loads(json.dumps(settings))
    found = study.user_attrs.get("settings")
    if found is None:
        if study.get_trials(deepcopy=False):
            raise UserError(f"study {name} was not made by sb3-e2c tune; take another --study-name")
        study.set_user_attr("settings", asked)
    elif found != asked:
        raise UserError(
            f"study {name} was started with other settings: {brief(_difference(found, asked))}; "
            "repeat its command to go on, or take another --study-name"
        )
    return study


def _difference(found: Any, asked: Any, where: str = "") -> str:
    """The first key in which two settings differ, and its values."""
    if isinstance(found, dict) and isinstance(asked, dict):
        for key in sorted(found.keys() | asked.keys()):
            if found.get(key) != asked.get(key):
                return _difference(found.get(key), asked.get(key), f"{where}.{key}".strip("."))
    return f"{where} was {found!r} there, and is {asked!r} now"


def violation(trial: FrozenTrial) -> float:
    """By how much its costs exceeded the limits, Σ_j max(0, J_j − l_j).

    :param trial: A trial
    """
    return sum(max(0.0, excess) for excess in trial.constraints.values())


def ranked(trials: Iterable[FrozenTrial]) -> list[FrozenTrial]:
    """Complete trials, the best first: return if all limits are kept, else the least violation.

    :param trials: Trials
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    return sorted(complete, key=lambda t: (violation(t), -cast(float, t.value), t.number))


def find_trial(study: optuna.Study, trial_id: str) -> FrozenTrial:
    """A trial that can be trained.

    :param study: The study
    :param trial_id: Its number, or "best"
    :raises UserError: if there is no such trial
    """
    trials = study.get_trials(deepcopy=False)
    if trial_id == "best":
        complete = ranked(trials)
        if not complete:
            raise UserError(f"study {study.study_name} has no complete trial yet")
        return complete[0]
    known = {str(trial.number): trial for trial in trials if "config" in trial.user_attrs}
    if trial_id not in known:
        numbers = brief(", ".join(known) or "none")
        raise UserError(f"--trial-id is {trial_id}; expected best, or one of the trials: {numbers}")
    return known[trial_id]


def trial_in_words(trial: FrozenTrial, limits: Sequence[float]) -> str:
    """What came of a trial, in one line.

    :param trial: A trial
    :param limits: Of the team, shape (M,)
    """
    words = [f"trial {trial.number}"]
    if "costs" in trial.user_attrs:
        words.append(
            f"return {trial.user_attrs['return']:.2f} ± {trial.user_attrs['return_se']:.2f}"
        )
        costs = ", ".join(f"{cost:.2f}" for cost in trial.user_attrs["costs"])
        words += [f"cost {costs}"] if costs else []
    if limits and "costs" in trial.user_attrs:
        kept = "kept" if violation(trial) == 0 else "exceeded"
        words.append(f"limit {', '.join(f'{limit:g}' for limit in limits)} {kept}")
    if "error" in trial.user_attrs:
        words.append(f"broke off: {trial.user_attrs['error']}")
    elif trial.state == TrialState.PRUNED:
        words.append("pruned")
    return ", ".join(words)


_NOT_WITH_A_TRIAL = {
    "preset": "--preset",
    "conf_file": "--conf-file",
    "trained_agent": "--trained-agent",
}


def trial_arguments(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> Namespace:
    """The command line of ``train`` that trains with the parameters of a trial.

    :param given: What was typed, by destination
    :param defaults: Values of all flags that were not
    :raises UserError: if there is no such trial, or flags contradict the study
    """
    args = Namespace(**{**defaults, **given})
    for name in _NOT_WITH_A_TRIAL.keys() & given.keys():
        raise UserError(f"{_NOT_WITH_A_TRIAL[name]} contradicts --trial-id, which gives everything")
    if args.trial_id is None:
        raise UserError(
            "--storage and --study-name are about --trial-id; give a trial's number, or best"
        )
    check_algo(args.algo)
    check_env(args.env)
    name = args.study_name or default_name(args.algo, args.env)
    study = load_study(args.storage, name, args.log_folder)
    settings = study.user_attrs.get("settings")
    if settings is None:
        raise UserError(f"study {name} was not made by sb3-e2c tune")
    for flag in ("algo", "env"):
        if flag in given and given[flag] != settings[flag]:
            raise UserError(f"study {name} is about --{flag} {settings[flag]}, not {given[flag]}")
    trial = find_trial(study, args.trial_id)
    if args.verbose > 0:
        print(f"Study {name}, {trial_in_words(trial, settings['limits'])}")
    args.algo, args.env, args.study_name = settings["algo"], settings["env"], name
    args.hyperparams = merge(
        trial.user_attrs["config"],
        {"env_kwargs": given.get("env_kwargs") or {}},
        given.get("hyperparams") or {},
    )
    return args
