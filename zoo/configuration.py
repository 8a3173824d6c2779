"""Hyperparameters of a run: read the YAML files, merge them, refuse what no one would read.

A run's configuration is defaults.yml, then the task's entry of envs.yml, the method's of algos.yml,
the presets, a ``--conf-file`` and ``-params``; later ones win and mappings merge. It has the
arguments of the algorithm's constructor, and ``ZOO_KEYS``. YAML is data: nothing in it is executed.
"""

import math
import re
import sys
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

from sb3_e2c import E2CMAPPO, MAPPO
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.zoo.console import UserError, brief, unknown
from sb3_e2c.zoo.parts import CLASSES, PARTS, class_named
from sb3_e2c.zoo.signatures import Argument, arguments_of, numbers_in

ALGORITHMS: dict[str, type[MAPPO]] = {
    "mappo": MAPPO,
    "c_mappo": MAPPO,
    "c_mappo_pe": MAPPO,
    "e2c": E2CMAPPO,
    "e2c_t": E2CMAPPO,
}
ZOO_KEYS: dict[str, Argument] = {
    "n_envs": Argument(int),
    "n_timesteps": Argument(int),
    "env_kwargs": Argument(dict | None),
    "normalize": Argument(bool | dict),
    "callback": Argument(str | list | dict | None),
}
FLAGS = ("env", "seed", "device", "verbose", "tensorboard_log")
FOLDER = Path(__file__).parent / "hyperparams"

# Naming another class drops the arguments of the old one.
_OWN_ARGUMENTS = {"estimator": "estimator_kwargs", "multipliers_class": "multipliers_kwargs"}
# Numbers by their key, wherever it stands
_COUNT, _SHARE, _AMOUNT = (1, sys.maxsize), (0, 1), (0, math.inf)
_BOUNDS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("n_envs", "n_timesteps", "n_steps", "batch_size", "n_epochs"), _COUNT),
    **dict.fromkeys(("stats_window_size", "net_arch", "gru_hidden_size"), _COUNT),
    **dict.fromkeys(("gamma", "gae_lambda", "cost_gamma", "cost_margin"), _SHARE),
    **dict.fromkeys(("learning_rate", "critic_learning_rate", "clip_range"), _AMOUNT),
    **dict.fromkeys(("clip_range_vf", "clip_obs", "clip_reward", "epsilon"), _AMOUNT),
    **dict.fromkeys(("ent_coef", "vf_coef", "max_grad_norm", "target_kl"), _AMOUNT),
    **dict.fromkeys(("cost_limits", "reward_scale"), _AMOUNT),
}


# A file may come from a stranger: a few lines of YAML can stand for gigabytes.
_LARGEST, _MOST_ALIASES, _DEEPEST = 2**18, 16, 20


class _Loader(yaml.SafeLoader):
    """Safe YAML in which 3e-4 is a number; YAML 1.1 takes it for a string."""

    n_aliases = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Read a node, unless it is one alias too many."""
        self.n_aliases += self.check_event(yaml.AliasEvent)
        if self.n_aliases > _MOST_ALIASES:
            raise yaml.YAMLError(f"it has more than {_MOST_ALIASES} aliases; write the values out")
        return super().compose_node(parent, index)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a mapping from a YAML file, as data only.

    :param path: The file
    :raises UserError: if there is no such file, or something else in it
    """
    try:
        with open(path, "rb") as file:
            text = file.read(_LARGEST + 1)
        content = None if len(text) > _LARGEST else yaml.load(text, Loader=_Loader)  # a SafeLoader
    except Exception as error:  # PyYAML lets out what int(), date() and others raise
        raise UserError(f"cannot read {path}: {brief(error)}") from None
    if len(text) > _LARGEST:
        raise UserError(f"{path} has more than {_LARGEST:,} bytes, expected a few lines of YAML")
    if not isinstance(content, dict):
        raise UserError(f"{path} holds {type(content).__name__}, expected a YAML mapping")
    if _is_deeper(content, _DEEPEST):
        raise UserError(f"{path} has more than {_DEEPEST} levels, expected plain YAML")
    return content


def _is_deeper(value: Any, levels: int) -> bool:
    inner = value.values() if isinstance(value, dict) else value
    if not isinstance(value, (dict, list, tuple, set)):
        return False
    return levels == 0 or any(_is_deeper(each, levels - 1) for each in inner)


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings, later ones over earlier ones.

    Naming another class (``estimator``, ``multipliers_class``) drops the arguments of the old one
    (``estimator_kwargs``, ``multipliers_kwargs``).

    :param layers: The mappings; none of them is changed
    """
    result: dict[str, Any] = {}
    for layer in layers:
        for key, arguments in _OWN_ARGUMENTS.items():
            if key in layer and result.get(key) not in (None, layer[key]):
                result.pop(arguments, None)
        for key, value in layer.items():
            if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
                result[key] = merge(result[key], value)
            else:
                result[key] = deepcopy(value)
    return result


def check_algo(algo: str) -> None:
    """Raise :class:`UserError` for an algorithm that the zoo does not know."""
    if algo not in ALGORITHMS:
        raise unknown("algorithm (--algo)", algo, ALGORITHMS)


def check_env(env_id: str) -> None:
    """Raise :class:`UserError` for an environment that the zoo does not know."""
    if env_id not in ENV_IDS:
        raise unknown("environment (--env)", env_id, ENV_IDS)


def preset_names() -> list[str]:
    """Names in presets.yml."""
    return list(read_yaml(FOLDER / "presets.yml"))


def parse_presets(text: str) -> list[str]:
    """Names in a comma-separated list.

    :param text: For instance ``pure,lambda_1``
    :raises UserError: for a name that presets.yml does not have
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in preset_names():
            raise unknown("preset (--preset)", name, preset_names())
    return names


def task_entry(env_id: str) -> dict[str, Any]:
    """The task's entry of envs.yml over the one it names as its base; empty if it has none.

    :param env_id: A key of ``ENV_IDS``
    """
    table = read_yaml(FOLDER / "envs.yml")
    entry = dict(table.get(env_id, {}))
    base = entry.pop("base", None)
    return merge(table[base] if base else {}, entry)


def team_limits(env_id: str, config: Mapping[str, Any]) -> list[float]:
    """Limits on the team's costs in a configuration; of a method without any, the task's.

    :param env_id: A key of ``ENV_IDS``
    :param config: See :func:`resolve`
    """
    limits = config.get("cost_limits")
    if limits is None:
        limits = task_entry(env_id).get("cost_limits")
    if limits is None:
        return []
    return [float(limit) for limit in (limits if isinstance(limits, list) else [limits])]


def resolve(
    algo: str,
    env_id: str,
    presets: Iterable[str] = (),
    overrides: Mapping[str, Any] | None = None,
    base: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The configuration of a run, checked.

    :param algo: A key of ``ALGORITHMS``
    :param env_id: A key of ``ENV_IDS``
    :param presets: Names in presets.yml, applied in this order
    :param overrides: What the user asked for
    :param base: Start from this instead of the shipped files, to continue a run
    :raises UserError: for unknown names and keys, and values of a wrong type or range
    """
    check_algo(algo)
    check_env(env_id)
    known = read_yaml(FOLDER / "presets.yml")
    methods = read_yaml(FOLDER / "algos.yml")
    defaults = read_yaml(FOLDER / "defaults.yml")
    start = [base] if base is not None else [defaults, task_entry(env_id), methods[algo]]
    shipped = merge(*start, *(known[name] for name in presets))
    # Files for all methods may hold what only some take (oem_kwargs); a user's key must be read.
    config = merge({key: shipped[key] for key in shipped if key in keys(algo)}, overrides or {})
    check(algo, config)
    return dict(sorted(config.items()))


def keys(algo: str) -> dict[str, Argument]:
    """Everything that a configuration may hold.

    :param algo: A key of ``ALGORITHMS``
    """
    arguments = arguments_of(ALGORITHMS[algo])
    no_numbers = (*FLAGS, "_init_setup_model")
    return {key: arguments[key] for key in arguments if key not in no_numbers} | ZOO_KEYS


def check(algo: str, config: Mapping[str, Any]) -> None:
    """Raise :class:`UserError` for unknown keys, and values of a wrong type or range.

    :param algo: A key of ``ALGORITHMS``
    :param config: The configuration
    """
    for key in FLAGS:
        if key in config:
            raise UserError(f"{key} is no hyperparameter; use the flag --{key.replace('_', '-')}")
    for key in ("policy", "n_envs", "n_timesteps", "n_steps"):
        if key not in config:
            raise UserError(
                f"{key} is missing for this environment; give it with -params {key}:..."
            )
    _check_arguments(f"hyperparameter for {algo}", "", config, keys(algo))
    if not config.get("oem_kwargs", True):
        raise UserError(
            f"oem_kwargs is empty, but {algo} explores by observation entropy; name an estimator, "
            "or take a method that does without"
        )


def _check_arguments(
    what: str, where: str, values: Mapping[str, Any], arguments: Mapping[str, Argument]
) -> None:
    """Check a mapping against a constructor, and all mappings in it against theirs."""
    for key, value in values.items():
        if key not in arguments:
            raise unknown(what, key, arguments)
        if not arguments[key].accepts(value):
            raise UserError(f"{where}{key} is {value!r}; expected {arguments[key].in_words()}")
        _check_bounds(where, key, value)
        if key in CLASSES:
            class_named(key, value, where)
    for key in arguments:
        if arguments[key].required and where and key not in values:
            raise UserError(f"{where}{key} is missing; give it with -params {where}{key}:...")
    for key in (key for key in PARTS if key in arguments):
        _check_part(where, key, values, arguments)


def _check_part(
    where: str, key: str, values: Mapping[str, Any], arguments: Mapping[str, Argument]
) -> None:
    """Check what stands under a key of ``PARTS`` against the class that it is for."""
    named_by, implied = PARTS[key]
    given = values.get(key)
    if isinstance(named_by, str):
        name = values.get(named_by)
        constructed = arguments[named_by].default if name is None else CLASSES[named_by][name]
    elif isinstance(given, Mapping):
        constructed = named_by
    else:  # not asked for
        return
    for name in implied:
        if name in (given or {}):
            raise UserError(f"{where}{key}.{name} follows from {implied[name]}; leave it out")
    expected = arguments_of(constructed)
    allowed = {name: expected[name] for name in expected if name not in implied}
    _check_arguments(f"key in {where}{key}", f"{where}{key}.", given or {}, allowed)


def _check_bounds(where: str, key: str, value: Any) -> None:
    low, high = _BOUNDS.get(key, (-math.inf, math.inf))
    for number in numbers_in(value):
        if not low <= number <= high:
            limit = f"at least {low}" if number < low else f"at most {high}"
            raise UserError(f"{where}{key} is {value!r}; expected {limit}")
