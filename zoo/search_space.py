"""What ``sb3-e2c tune`` searches: the table hyperparameters/search_space.yml, and a user's changes.

Values are those of a configuration (see ``configuration.py``), under the dotted keys of -params.
"""

import fnmatch
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna

from sb3_e2c import MAPPO
from sb3_e2c.zoo.configuration import FOLDER, check, keys, merge, read_yaml
from sb3_e2c.zoo.console import UserError
from sb3_e2c.zoo.parts import CLASSES, PARTS
from sb3_e2c.zoo.signatures import Argument, arguments_of, schedule_start

_LINEAR, _LOG, _LOG_TO_1 = "linear", "log", "log(1 - x)"
_SCALES = (_LINEAR, _LOG, _LOG_TO_1)
_DIGITS = 4  # of numbers that are tried: more would be noise
_FORM = "{low: A, high: B} (perhaps with scale: log), a list of values, or null"


@dataclass(frozen=True)
class Dimension:
    """One hyperparameter and the values that are tried.

    :param key: Its dotted key
    :param low: Smallest number
    :param high: Largest number
    :param scale: "linear", "log" or "log(1 - x)"
    :param choices: The values instead, if they are no range
    """

    key: str
    low: float = 0
    high: float = 0
    scale: str = _LINEAR
    choices: tuple[Any, ...] = ()

    @property
    def name(self) -> str:
        """What Optuna calls it: a number close to 1 is searched by its distance from 1."""
        return f"1 - {self.key}" if self.scale == _LOG_TO_1 else self.key

    @property
    def _whole(self) -> bool:
        return isinstance(self.low, int) and isinstance(self.high, int)

    def suggest(self, trial: optuna.Trial) -> Any:
        """The value for a trial.

        :param trial: The trial
        """
        if self.choices:
            labels = {_label(choice): choice for choice in self.choices}
            return labels[trial.suggest_categorical(self.name, list(labels))]
        log = self.scale == _LOG
        if self._whole:
            return trial.suggest_int(self.name, int(self.low), int(self.high), log=log)
        if self.scale == _LOG_TO_1:
            nearest, farthest = _from_1(self.high), _from_1(self.low)
            return _from_1(_rounded(trial.suggest_float(self.name, nearest, farthest, log=True)))
        return _rounded(trial.suggest_float(self.name, self.low, self.high, log=log))

    def contains(self, value: Any) -> bool:
        """Whether it may be tried.

        :param value: A value from a configuration
        """
        if self.choices:
            return value in self.choices
        return isinstance(value, int | float) and self.low <= value <= self.high

    def encoded(self, value: Any) -> Any:
        """What Optuna stores for it.

        :param value: A value that it contains
        """
        if self.choices:
            return _label(value)
        return _from_1(value) if self.scale == _LOG_TO_1 else value

    def samples(self) -> list[Any]:
        """Values that show whether all of them can be meant."""
        return list(self.choices) or [self.low, self.high]

    def plain(self) -> Any:
        """As it stands in the table."""
        if self.choices:
            return list(self.choices)
        scale = {} if self.scale == _LINEAR else {"scale": self.scale}
        return {"low": self.low, "high": self.high, **scale}


def _label(choice: Any) -> Any:
    """Storages hold plain values only: lists and mappings are written as text."""
    return json.dumps(choice) if isinstance(choice, list | dict) else choice


def _rounded(number: float) -> float:
    return float(f"{number:.{_DIGITS}g}")


def _from_1(number: float) -> float:
    return round(1 - number, 10)


def nested(key: str, value: Any) -> dict[str, Any]:
    """A value under a dotted key, as a configuration holds it.

    :param key: For instance oem_kwargs.psi
    :param value: The value
    """
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


class SearchSpace:
    """The dimensions that a method reads, around its configuration.

    :param algo: A key of ``ALGORITHMS``
    :param config: What stays as it is; see :func:`sb3_e2c.zoo.configuration.resolve`
    :param fixed: What the user has decided, and is not searched
    :param path: The user's file, if there is one
    :raises UserError: if there is nothing to search, or something that cannot be meant
    """

    def __init__(
        self,
        algo: str,
        config: Mapping[str, Any],
        fixed: Mapping[str, Any] | None = None,
        path: Path | None = None,
    ):
        self.algo, self.config = algo, config
        own = {} if path is None else _read_own(path)
        named = [key for key in own if own[key] is not None]
        shipped = read_yaml(FOLDER / "search_space.yml")
        kept = [key for key in shipped if not _dropped(key, own) and not _is_fixed(key, fixed)]
        table = {key: shipped[key] for key in kept if self._is_used(key)}
        table |= {key: own[key] for key in named}
        self.dimensions = [_dimension(key, entry) for key, entry in table.items()]
        for dimension in self.dimensions:
            for value in dimension.samples():
                check(algo, merge(config, nested(dimension.key, value)))
        for key in named:
            self._check_named(key, fixed)
        if not self.dimensions:
            raise UserError(
                "nothing is left to search; name hyperparameters in the file of --space"
            )

    def _is_used(self, key: str) -> bool:
        """Whether the method reads it, and does not do without it on purpose."""
        return _is_read(self.algo, self.config, key) and bool(self.current(key))

    def _check_named(self, key: str, fixed: Mapping[str, Any] | None) -> None:
        if _is_fixed(key, fixed):
            raise UserError(f"--space searches {key}, but -params fixes it; leave one of them out")
        if not _is_read(self.algo, self.config, key):
            raise UserError(f"--space: {self.algo} does not read {key} here; leave it out")

    def current(self, key: str) -> Any:
        """The value in the configuration; of a schedule, its start.

        :param key: A dotted key that the method reads
        """
        value = self._written(key)
        start = schedule_start(value)
        return value if start is None else start

    def _written(self, key: str) -> Any:
        return _value_of(keys(self.algo), self.config, key.split("."))

    def _in_place(self, dimension: Dimension, value: Any) -> Any:
        """A number becomes a schedule where the configuration has one."""
        is_schedule = schedule_start(self._written(dimension.key)) is not None
        return f"lin_{value:g}" if is_schedule else value

    def suggest(self, trial: optuna.Trial) -> dict[str, Any]:
        """The configuration of a trial.

        :param trial: The trial
        """
        layers = (nested(d.key, self._in_place(d, d.suggest(trial))) for d in self.dimensions)
        return merge(self.config, *layers)

    def start(self) -> dict[str, Any]:
        """The configuration as it is, in Optuna's terms; without what lies outside the space."""
        pairs = [(each, self.current(each.key)) for each in self.dimensions]
        return {d.name: d.encoded(value) for d, value in pairs if d.contains(value)}

    def hold_opponents(self) -> None:
        """Let opponents learn as they would without the search.

        They take over the team's arguments; a search would find what makes them learn badly.
        """
        own = [d.key for d in self.dimensions if d.key in MAPPO.opponent_arguments]
        held = {key: self._written(key) for key in own}
        self.config = merge({"opponent_kwargs": held}, self.config)

    def plain(self) -> dict[str, Any]:
        """As a file for --space."""
        return {each.key: each.plain() for each in self.dimensions}


def _read_own(path: Path) -> dict[str, Any]:
    own = read_yaml(path)
    for key in own:
        if not isinstance(key, str):
            raise UserError(f"{path}: found the key {key!r}; expected one like oem_kwargs.psi")
    return own


def _dropped(key: str, own: Mapping[str, Any]) -> bool:
    return any(fnmatch.fnmatchcase(key, each) for each in own if own[each] is None)


def _is_fixed(key: str, fixed: Mapping[str, Any] | None, outer: str = "") -> bool:
    """Whether the key, something in it, or something that it stands in was given."""
    for name, value in (fixed or {}).items():
        given = outer + name
        if key == given or given.startswith(f"{key}."):
            return True
        if key.startswith(f"{given}."):
            return not isinstance(value, Mapping) or _is_fixed(key, value, f"{given}.")
    return False


def _dimension(key: str, entry: Any) -> Dimension:
    wrong = UserError(f"{key} is {entry!r} in the search space; expected {_FORM}")
    if isinstance(entry, list):
        if not entry:
            raise wrong
        return Dimension(key, choices=tuple(entry))
    if not isinstance(entry, dict) or not {"low", "high"} <= entry.keys() <= _KEYS:
        raise wrong
    low, high, scale = entry["low"], entry["high"], entry.get("scale", _LINEAR)
    if not all(isinstance(n, int | float) and not isinstance(n, bool) for n in (low, high)):
        raise wrong
    if scale not in _SCALES:
        raise UserError(f"{key}: scale is {scale!r}; expected one of {', '.join(_SCALES)}")
    if not low < high or (scale == _LOG and low <= 0) or (scale == _LOG_TO_1 and high >= 1):
        room = {_LOG: "0 < low < high", _LOG_TO_1: "low < high < 1"}.get(scale, "low < high")
        raise UserError(f"{key} goes from {low} to {high}; expected {room} (scale: {scale})")
    return Dimension(key, low, high, scale)


_KEYS = {"low", "high", "scale"}


def _is_read(algo: str, config: Mapping[str, Any], key: str) -> bool:
    """Whether a value under this key would change anything."""
    part, oem = key.split(".")[0], config.get("oem_kwargs")
    of_limits = part.startswith("multipliers_") or part in ("cost_gamma", "cost_margin")
    if of_limits and config.get("cost_limits") in (None, []):
        return False
    if part == "reward_scale" and oem and oem.get("psi") is None:  # the bonus replaces the reward
        return False
    try:
        _value_of(keys(algo), config, key.split("."))
    except KeyError:
        return False
    return True


def _value_of(arguments: Mapping[str, Argument], config: Mapping[str, Any], path: list[str]) -> Any:
    """A value in a configuration, or what stands for it if it is not given.

    :param arguments: What may stand in the configuration
    :param config: The configuration, or a mapping in it
    :param path: The parts of a dotted key
    :raises KeyError: if there is no such argument
    """
    name, *rest = path
    argument, given = arguments[name], config.get(name)
    if not rest:
        return config.get(name, None if argument.required else argument.default)
    if name in PARTS:
        return _value_of(_arguments_in(name, arguments, config), given or {}, rest)
    for each in rest:  # a plain mapping, such as net_arch
        if not isinstance(given, Mapping):
            return None
        given = given.get(each)
    return given


def _arguments_in(
    part: str, arguments: Mapping[str, Argument], config: Mapping[str, Any]
) -> dict[str, Argument]:
    """What may stand under a key of ``PARTS``."""
    named_by, implied = PARTS[part]
    if isinstance(named_by, str):
        name = config.get(named_by)
        constructed = arguments[named_by].default if name is None else CLASSES[named_by][name]
    else:
        constructed = named_by
    expected = arguments_of(constructed)
    return {name: expected[name] for name in expected if name not in implied}
