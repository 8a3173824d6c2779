"""What a constructor takes, and whether a value from a YAML file can stand for it."""

import inspect
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

_REQUIRED = inspect.Parameter.empty
_WORDS: dict[Any, str] = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a name",
    dict: "a mapping",
    type(None): "null",
}
_PLURALS = {float: "numbers", int: "whole numbers", str: "names"}
_SCHEDULE = "lin_"  # RL-Zoo's: lin_3e-4 falls from 3e-4 to 0


class Argument(NamedTuple):
    """One argument of a constructor.

    :param kind: Its type
    :param default: What stands for it if it is left out
    """

    kind: Any
    default: Any = _REQUIRED

    @property
    def required(self) -> bool:
        """Whether it has no default."""
        return self.default is _REQUIRED

    def accepts(self, value: Any) -> bool:
        """Whether a value from YAML can stand for it; its own default always can."""
        return _has_type(value, self.kind) or (value == self.default and not self.required)

    def in_words(self) -> str:
        """What it expects, for instance "a number or null"."""
        *first, last = dict.fromkeys(_words(self.kind))  # each once
        return f"{', '.join(first)} or {last}" if first else last


def arguments_of(constructed: type) -> dict[str, Argument]:
    """Arguments of a constructor, with those that it passes on to its base classes.

    :param constructed: A class
    """
    arguments: dict[str, Argument] = {}
    for each in constructed.__mro__:
        constructor = vars(each).get("__init__")
        if not inspect.isfunction(constructor):
            continue
        parameters = list(inspect.signature(constructor).parameters.values())[1:]  # after self
        hints = typing.get_type_hints(constructor)
        for parameter in parameters:
            if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
                argument = Argument(hints.get(parameter.name, Any), parameter.default)
                arguments.setdefault(parameter.name, argument)
        if all(parameter.kind != parameter.VAR_KEYWORD for parameter in parameters):
            break
    return arguments


def schedule_start(value: Any) -> float | None:
    """The number at which a schedule such as ``lin_3e-4`` starts; None if it is none.

    :param value: A value from YAML
    """
    if not (isinstance(value, str) and value.startswith(_SCHEDULE)):
        return None
    try:
        start = float(value.removeprefix(_SCHEDULE))
    except ValueError:
        return None
    return start if math.isfinite(start) else None


def numbers_in(value: Any) -> Iterator[float]:
    """All numbers in a value from YAML, however deep, with the starts of schedules.

    :param value: A value from YAML
    """
    start = schedule_start(value)
    if start is not None:
        yield start
    elif isinstance(value, Mapping):
        yield from numbers_in(list(value.values()))
    elif isinstance(value, list):
        for each in value:
            yield from numbers_in(each)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _has_type(value: Any, expected: Any = Any) -> bool:
    kind, options = typing.get_origin(expected) or expected, typing.get_args(expected)
    if kind in _GENERIC:
        return _GENERIC[kind](value, options)
    if kind in (float, int) and isinstance(value, bool):
        return False
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    # The rest are plain types, and objects that YAML cannot hold.
    return kind is Any or (kind in _WORDS and isinstance(value, kind))


def _any_of(value: Any, options: tuple[Any, ...]) -> bool:
    return any(_has_type(value, option) for option in options)


def _one_of(value: Any, options: tuple[Any, ...]) -> bool:
    return value in options


def _is_name(value: Any, _: tuple[Any, ...]) -> bool:
    return isinstance(value, str)


def _is_schedule(value: Any, _: tuple[Any, ...]) -> bool:
    return schedule_start(value) is not None


def _is_list(value: Any, options: tuple[Any, ...]) -> bool:
    return isinstance(value, list) and all(_has_type(each, *options[:1]) for each in value)


def _is_tuple(value: Any, options: tuple[Any, ...]) -> bool:
    if not isinstance(value, list) or Ellipsis in options:
        return _is_list(value, options)
    return len(value) == len(options) and all(map(_has_type, value, options))


def _is_mapping(value: Any, options: tuple[Any, ...]) -> bool:
    return isinstance(value, dict) and _is_list(list(value.values()), options[1:])


_GENERIC: dict[Any, Callable[[Any, tuple[Any, ...]], bool]] = {
    typing.Union: _any_of,
    types.UnionType: _any_of,
    typing.Literal: _one_of,
    type: _is_name,  # classes are given by name, see parts.py
    Callable: _is_schedule,
    dict: _is_mapping,
    list: _is_list,
    Sequence: _is_list,
    tuple: _is_tuple,
}


def _words(kind: Any) -> Iterator[str]:
    """A phrase for each value that YAML can hold and the type allows."""
    origin, options = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        for option in options:
            yield from _words(option)
    elif origin is typing.Literal:
        yield from (repr(option) for option in options)
    elif origin in (list, tuple, Sequence):
        yield f"a list of {_PLURALS.get(options[0] if options else Any, 'values')}"
    elif origin is type:
        yield "a name"
    elif origin is Callable:
        yield "a schedule such as lin_3e-4"
    elif origin in _WORDS:
        yield _WORDS[origin]
