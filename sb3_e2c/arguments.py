"""What the arguments of a model may be: a table of rules, and one function that applies them.

A thing of the wrong kind is a TypeError, a number out of range a ValueError. NumPy's numbers become
Python's, which Stable-Baselines3 asks for.
"""

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_e2c.multipliers import LARGEST, fits_torch


class Rule(NamedTuple):
    """What one argument may be.

    :param expected: In words
    :param accept: Returns the value to go on with, or raises whatever it likes
    """

    expected: str
    accept: Callable[[Any], Any]


# ---------------------------------------------------------------------------- kinds of values


def _real(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError
    return float(value)


def _number(expected: str, fits: Callable[[float], bool]) -> Rule:
    def accept(value: Any) -> float:
        number = _real(value)
        if not fits(number):
            raise ValueError
        return number

    return Rule(expected, accept)


def _whole(expected: str, least: int, most: int = sys.maxsize) -> Rule:
    def accept(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise TypeError
        if not least <= value <= most:  # type: ignore[operator]
            raise ValueError
        return int(value)

    return Rule(expected, accept)


def _a(expected: str, *kinds: type) -> Rule:
    def accept(value: Any) -> Any:
        if not isinstance(value, kinds):
            raise TypeError
        return value

    return Rule(expected, accept)


def _or_none(rule: Rule) -> Rule:
    return Rule(
        f"{rule.expected}, or None", lambda value: None if value is None else rule.accept(value)
    )


def _or_schedule(rule: Rule, ends: Rule) -> Rule:
    """Also a function from the remaining progress, asked at the beginning and at the end."""

    def accept(value: Any) -> Any:
        if not callable(value):
            return rule.accept(value)
        for progress in (1.0, 0.0):
            ends.accept(float(value(progress)))
        return value

    return Rule(f"{rule.expected}, or a schedule of such numbers from 1 to 0", accept)


def _mapping(value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise TypeError
    return dict(value)


def _device(value: Any) -> str | th.device:
    """Stable-Baselines3 takes the CPU where there is no CUDA; any other device has to compute."""
    if not isinstance(value, (str, th.device)):
        raise TypeError
    if value != "auto":
        device = th.device(value)
        if device.type != "cuda" or th.cuda.is_available():
            th.zeros(1, device=device).item()
    return value


# ---------------------------------------------------------------------------- the table

COUNT = _whole("a whole number of at least 1", 1)
SHARE = _number("a number from 0 to 1", lambda number: 0 <= number <= 1)
AMOUNT = _number("a number of at least 0", lambda number: number >= 0 and fits_torch(number))
FACTOR = _number(f"a number from 0 to {LARGEST:.1e}", lambda number: 0 <= number <= LARGEST)
FINITE = _number("a finite number of at least 0", lambda number: 0 <= number < math.inf)
POSITIVE = _number("a number greater than 0", lambda number: number > 0 and fits_torch(number))
SWITCH = Rule("True or False", lambda value: bool(_a("", bool, np.bool_).accept(value)))
KEYWORDS = Rule("a dict of arguments by their names, or None", _mapping)

# Attributes of the model, which load() may replace, too
ATTRIBUTES: dict[str, Rule] = {
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs"), COUNT),
    **dict.fromkeys(("gamma", "gae_lambda"), SHARE),
    "cost_margin": _number("a number from 0, and less than 1", lambda number: 0 <= number < 1),
    "cost_gamma": _or_none(SHARE),
    "learning_rate": _or_schedule(FINITE, FINITE),
    "critic_learning_rate": _or_none(_or_schedule(FINITE, FINITE)),
    "clip_range": _or_schedule(AMOUNT, AMOUNT),
    "clip_range_vf": _or_none(_or_schedule(POSITIVE, AMOUNT)),
    **dict.fromkeys(("ent_coef", "vf_coef", "reward_scale"), FACTOR),
    "max_grad_norm": AMOUNT,
    "target_kl": _or_none(AMOUNT),
    **dict.fromkeys(("normalize_advantage", "normalize_values"), SWITCH),
    **dict.fromkeys(("policy_kwargs", "multipliers_kwargs", "opponent_kwargs"), KEYWORDS),
    "update_threads": _or_none(_whole("1 or 2", 1, 2)),
    "seed": _or_none(_whole("a whole number from 0 to 2**32 - 1", 0, 2**32 - 1)),
    "tensorboard_log": _or_none(_a("the name of a folder", str, os.PathLike)),
}
RULES: dict[str, Rule] = {
    **ATTRIBUTES,
    "oem_kwargs": KEYWORDS,
    "stats_window_size": COUNT,
    "verbose": Rule(
        "a whole number of at least 0",
        lambda value: _whole("", 0).accept(int(value) if isinstance(value, bool) else value),
    ),
    "device": Rule("'auto', or a device that torch can use here, such as 'cpu'", _device),
}


def checked(name: str, value: Any) -> Any:
    """An argument as the model shall have it.

    :param name: A key of ``RULES``
    :param value: What the user gave
    :raises TypeError: for a thing of another kind
    :raises ValueError: for a number out of range, a schedule that fails, a device that is not there
    """
    rule = RULES[name]
    try:
        return rule.accept(value)
    except Exception as error:  # a schedule may raise anything
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"{name} is {_shown(value)}; expected {rule.expected}") from error


def settle(model: Any) -> None:
    """Check what a model has been given, and turn NumPy's numbers into Python's.

    :param model: Has the attributes of ``ATTRIBUTES``
    """
    for name in ATTRIBUTES:
        setattr(model, name, checked(name, getattr(model, name)))


@contextmanager
def making(model: Any, policy_kwargs: Any) -> Iterator[None]:
    """Say of an error in torch or NumPy which arguments it comes from.

    :param model: Its rollout buffer and networks are made inside
    :param policy_kwargs: What the user gave
    :raises ValueError: also for networks that begin with numbers that are not finite
    """
    given = f"n_steps={model.n_steps}, policy_kwargs={policy_kwargs}"
    try:
        yield
    except (TypeError, ValueError, AssertionError, OverflowError) as error:
        raise ValueError(f"{error}; found in {given}") from error
    for name, parameter in model.policy.named_parameters():
        if not th.isfinite(parameter).all():
            raise ValueError(f"{name} begins with numbers that are not finite; found in {given}")


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except Exception:  # of the user's own class, or an integer of too many digits
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= 200 else f"{text[:200]}..."
