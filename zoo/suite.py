"""Suites: what ``benchmark`` runs and ``plot`` draws, read from a YAML file.

A suite has methods (settings of an algorithm) and experiments (environments x methods, one figure
each). A job is one method on one environment with one seed; experiments may share jobs.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import yaml

from sb3_e2c.zoo.configuration import check_algo, merge, parse_presets, read_yaml, resolve
from sb3_e2c.zoo.console import UserError, unknown

FOLDER = Path(__file__).parent / "suites"
# Keys of a suite file with the types of their values
_SUITE: dict[str, type | tuple[type, ...]] = {
    "base": str,
    "title": str,
    "seeds": (int, list),
    "window": int,
    "eval_episodes": int,
    "n_timesteps": int,
    "preset": str,
    "methods": dict,
    "experiments": dict,
}
_METHOD: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("name", "algo", "preset"), str),
    **dict.fromkeys(("params", "env_kwargs"), dict),
}
_EXPERIMENT: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("figure", "title"), str),
    **dict.fromkeys(("envs", "methods", "baselines"), list),
    "n_timesteps": int,
}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")  # names of folders on every system


@dataclass(frozen=True)
class Method:
    """An algorithm with its settings.

    :param label: Its key in the suite, and its folder
    :param name: For people
    :param algo: A key of ``ALGORITHMS``
    :param preset: As for ``train --preset``: the suite's, then its own
    :param params: As for ``train -params``
    :param env_kwargs: As for ``train --env-kwargs``
    """

    label: str
    name: str
    algo: str
    preset: str = "headline"
    params: dict[str, Any] = field(default_factory=dict, hash=False)
    env_kwargs: dict[str, Any] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class Experiment:
    """What one figure compares.

    :param id: Its key in the suite
    :param figure: Number of the figure, for people
    :param title: What it shows
    :param envs: Environment ids, a row of the figure each
    :param methods: Labels, a curve each
    :param baselines: Those of the labels that the others are compared with
    :param n_timesteps: Agent steps of a run; None: the environment's own
    """

    id: str
    figure: str
    title: str
    envs: tuple[str, ...]
    methods: tuple[str, ...]
    baselines: tuple[str, ...] = ()
    n_timesteps: int | None = None


@dataclass(frozen=True)
class Job:
    """One run.

    :param suite: Name of the suite
    :param env: Environment id
    :param method: What is trained
    :param seed: Its seed
    :param n_timesteps: Agent steps; None: the environment's own
    :param window: Episodes that make a row of curve.csv
    :param eval_episodes: World episodes of each evaluation
    """

    suite: str
    env: str
    method: Method
    seed: int
    n_timesteps: int | None
    window: int = 100
    eval_episodes: int = 100

    @property
    def name(self) -> str:
        """Where it lies below the suite's folder."""
        return f"{self.env}/{self.method.label}/seed_{self.seed}"

    def configuration(self) -> dict[str, Any]:
        """All settings of the run; ``n_timesteps`` is how long it is.

        :raises UserError: if the zoo refuses them
        """
        overrides = {**self.method.params, "env_kwargs": self.method.env_kwargs}
        if self.n_timesteps is not None:
            overrides["n_timesteps"] = self.n_timesteps
        return resolve(self.method.algo, self.env, parse_presets(self.method.preset), overrides)

    def settings(self) -> dict[str, Any]:
        """Plain data from which :meth:`from_settings` makes the same job."""
        return asdict(self)

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> "Job":
        """The job that :meth:`settings` describes."""
        return cls(**{**settings, "method": Method(**settings["method"])})


@dataclass(frozen=True)
class Suite:
    """Experiments that belong together.

    :param name: Name of its file without the ending
    :param title: For people
    :param seeds: Seeds of each method on each environment
    :param methods: By label
    :param experiments: In the order in which they are run
    :param window: See :class:`Job`
    :param eval_episodes: See :class:`Job`
    """

    name: str
    title: str
    seeds: tuple[int, ...]
    methods: dict[str, Method]
    experiments: tuple[Experiment, ...]
    window: int = 100
    eval_episodes: int = 100

    def jobs(self, seeds: Sequence[int] | None = None, only: Sequence[str] = ()) -> list[Job]:
        """The runs, each once: experiment by experiment, seed by seed.

        :param seeds: Other seeds than the suite's
        :param only: Patterns as in a shell; ``EXPERIMENT/ENV/METHOD/seed_S`` must match one
        :raises UserError: if nothing matches
        """
        found: dict[str, Job] = {}
        for experiment in self.experiments:
            for job in self._jobs_of(experiment, self.seeds if seeds is None else seeds):
                name = f"{experiment.id}/{job.name}"
                if not only or any(fnmatchcase(name, pattern) for pattern in only):
                    found.setdefault(job.name, job)
        if not found:
            example = f"{self.experiments[0].id}/*"
            raise UserError(
                f"--only {' '.join(only)} matches no EXPERIMENT/ENV/METHOD/seed_SEED of the suite "
                f"{self.name}; for example {example!r} would"
            )
        return list(found.values())

    def _jobs_of(self, experiment: Experiment, seeds: Iterable[int]) -> list[Job]:
        how = (experiment.n_timesteps, self.window, self.eval_episodes)
        return [
            Job(self.name, env, self.methods[label], seed, *how)
            for seed in seeds
            for env in experiment.envs
            for label in experiment.methods
        ]


def suite_names() -> list[str]:
    """Suites that are shipped."""
    return sorted(path.stem for path in FOLDER.glob("*.yml"))


def find_suite(name: str) -> Path:
    """The file of a shipped suite, or a file of the user's.

    :param name: A name, or a path that ends in .yml
    :raises UserError: if there is none
    """
    if name.endswith((".yml", ".yaml")):
        return Path(name)
    if name not in suite_names():
        raise unknown("suite (--suite)", name, suite_names())
    return FOLDER / f"{name}.yml"


def read_suite(path: Path, name: str | None = None) -> Suite:
    """Read and check a suite file.

    :param path: The file
    :param name: What it is called; default: as the file
    :raises UserError: for anything in it that cannot be meant; algorithms, presets and environments
        are not looked up
    """
    name = path.stem if name is None else name
    _check_name(path, "name of the file", name)
    content = _read_content(path)
    for key in ("window", "eval_episodes", "n_timesteps"):
        _check_positive(path, key, content)
    methods = {
        label: _read_method(path, str(label), entry or {}, content.get("preset", "headline"))
        for label, entry in content["methods"].items()
    }
    experiments = tuple(
        _read_experiment(path, str(key), entry, methods, content.get("n_timesteps"))
        for key, entry in content["experiments"].items()
    )
    _check_agreement(path, experiments)
    counts = {key: content[key] for key in ("window", "eval_episodes") if key in content}
    seeds = _seeds(path, content.get("seeds", 1))
    return Suite(name, content.get("title", name), seeds, methods, experiments, **counts)


def suite_text(path: Path) -> str:
    """The content of a suite file that needs no other file.

    :param path: The file
    :raises UserError: for keys that cannot be meant
    """
    if "base" not in read_yaml(path):
        return path.read_text()
    return yaml.safe_dump(_read_content(path), sort_keys=False, allow_unicode=True)


def _read_content(path: Path) -> dict[str, Any]:
    """A suite file over the shipped one that it names as its base."""
    content = read_yaml(path)
    _check_keys(path, "", content, _SUITE)
    base = content.pop("base", None)
    if base is not None:
        others = [name for name in suite_names() if find_suite(name).resolve() != path.resolve()]
        if base not in others:
            raise UserError(f"{path}: {unknown('suite (base)', base, others)}")
        content = merge(_read_content(FOLDER / f"{base}.yml"), content)
    _check_keys(path, "", content, _SUITE, required=("methods", "experiments"))
    return content


def _seeds(path: Path, value: Any) -> tuple[int, ...]:
    seeds = tuple(value) if isinstance(value, list) else tuple(range(value))
    if not seeds or any(type(seed) is not int or seed < 0 for seed in seeds):
        raise UserError(f"{path}: seeds is {value!r}; expected how many, or a list of them")
    return seeds


def _read_method(path: Path, label: str, entry: Any, preset: str) -> Method:
    where = f"methods.{label}"
    _check_name(path, "label of the method", label)
    _check_keys(path, f"{where}.", entry, _METHOD)
    presets = ",".join([preset, *([entry["preset"]] if "preset" in entry else [])])
    names = {"label": label, "name": label, "algo": label}
    return Method(**{**names, **entry, "preset": presets})


def check_methods(path: Path, suite: Suite) -> None:
    """Refuse algorithms and presets that do not exist; old results are drawn without them.

    :param path: The suite's file
    :param suite: What :func:`read_suite` has read there
    :raises UserError: for the first that is unknown
    """
    for label, method in suite.methods.items():
        try:
            check_algo(method.algo)
            parse_presets(method.preset)
        except UserError as error:
            raise UserError(f"{path}: methods.{label}: {error}") from None


def _read_experiment(
    path: Path, key: str, entry: Any, methods: Mapping[str, Method], n_timesteps: int | None
) -> Experiment:
    where = f"experiments.{key}"
    _check_name(path, "key of the experiment", key)
    _check_keys(path, f"{where}.", entry, _EXPERIMENT, required=("envs", "methods"))
    _check_positive(path, "n_timesteps", entry)
    for name in ("envs", "methods"):
        if not entry[name] or not all(isinstance(each, str) for each in entry[name]):
            raise UserError(f"{path}: {where}.{name} is {entry[name]!r}; expected names")
    for env in entry["envs"]:
        _check_name(path, f"environment in {where}", env)
    for name, known in (("methods", methods), ("baselines", entry["methods"])):
        for label in entry.get(name, ()):
            if label not in known:
                raise UserError(f"{path}: {where}.{name}: {unknown('method', label, known)}")
    lists = {name: tuple(entry.get(name, ())) for name in ("envs", "methods", "baselines")}
    figure, title = entry.get("figure", key), entry.get("title", "")
    return Experiment(
        key, figure, title, **lists, n_timesteps=entry.get("n_timesteps", n_timesteps)
    )


def _check_agreement(path: Path, experiments: Iterable[Experiment]) -> None:
    """Experiments that share runs must ask for the same length of them."""
    lengths: dict[tuple[str, str], int | None] = {}
    for each in experiments:
        for run in ((env, label) for env in each.envs for label in each.methods):
            if lengths.setdefault(run, each.n_timesteps) != each.n_timesteps:
                raise UserError(
                    f"{path}: {run[1]} on {run[0]} stands in two experiments with different "
                    "n_timesteps; give one of them another label"
                )


def _check_keys(
    path: Path,
    where: str,
    entry: Any,
    known: Mapping[str, type | tuple[type, ...]],
    required: Iterable[str] = (),
) -> None:
    if not isinstance(entry, dict):
        raise UserError(f"{path}: {where.rstrip('.')} is {entry!r}; expected a mapping")
    for key, value in entry.items():
        if key not in known:
            raise UserError(
                f"{path}: {unknown('key', f'{where}{key}', (where + k for k in known))}"
            )
        if not isinstance(value, known[key]) or isinstance(value, bool):
            kinds = known[key] if isinstance(known[key], tuple) else (known[key],)
            expected = " or ".join(kind.__name__ for kind in kinds)  # type: ignore[union-attr]
            raise UserError(f"{path}: {where}{key} is {value!r}; expected {expected}")
    for key in required:
        if not entry.get(key):
            raise UserError(f"{path}: {where}{key} is missing or empty")


def _check_positive(path: Path, key: str, entry: Mapping[str, Any]) -> None:
    if entry.get(key, 1) < 1:
        raise UserError(f"{path}: {key} is {entry[key]}; expected at least 1")


def _check_name(path: Path, what: str, name: str) -> None:
    if _NAME.fullmatch(name) is None:
        raise UserError(
            f"{path}: {what} is {name!r}; expected letters, digits and _ . + - because a folder "
            "will have that name"
        )
