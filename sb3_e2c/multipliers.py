"""Lagrange multipliers: the price of violating a cost limit (Eqs. 6, 7; Alg. 2 l. 11).

A multiplier object owns λ of shape (K, M), K being 1 for team constraints and N for individual
ones, and changes it with one verb, ``update(violation)``.
"""

import math
from abc import ABC, abstractmethod
from numbers import Real
from typing import Any

import torch as th
from torch import nn

LARGEST = float(th.finfo(th.float32).max)


def fits_torch(number: float) -> bool:
    """Whether torch takes a number beside the networks' numbers.

    :param number: Not negative; infinity fits
    """
    return number <= LARGEST or number == math.inf


class Multipliers(nn.Module, ABC):
    """What the algorithm needs to know; write your own by subclassing.

    Whatever must survive saving and loading is a buffer of the module.
    """

    values: th.Tensor  # λ, shape (K, M)

    def __init__(self, shape: tuple[int, int], **kwargs: Any):  # noqa: ARG002
        super().__init__()

    def extra_repr(self) -> str:
        """The multipliers, for ``print``."""
        return f"values={self.values.tolist()}"

    @abstractmethod
    def update(self, violation: th.Tensor) -> None:
        """Take one dual step.

        :param violation: J − l, shape (K, M)
        """


class GradientMultipliers(Multipliers):
    """Projected gradient ascent on the violation (Eq. 7).

    λ ← min(λ_max, max(0, λ + η (J − l)))

    :param shape: (K, M)
    :param learning_rate: Step size η (Table 1: 0.05), in reward per squared unit of cost
    :param initial: λ at the start (Alg. 2: 0; Table 1: 1)
    :param maximum: λ_max; infinite as in the paper ("growing unbounded")
    :param agent_scaling: Multiply the step by K. An individual violation is about N times smaller
        than the team's, so that the multipliers of both kinds of constraints move alike; False
        takes the paper's literal step (docs/paper.md, D8)
    :param pooled: Move all parties' multipliers alike, by their mean violation. Individual
        constraints then limit the team as a whole, while every agent answers for its own cost
    :param largest_violation: A larger one counts as this much, in units of cost. At first costs
        may be a hundred times what is allowed; a step that suits what comes later would overshoot
    """

    def __init__(
        self,
        shape: tuple[int, int],
        learning_rate: float = 0.05,
        initial: float = 0.0,
        maximum: float = math.inf,
        agent_scaling: bool = True,
        pooled: bool = False,
        largest_violation: float = math.inf,
    ):
        super().__init__(shape)
        _check_form(shape, agent_scaling=agent_scaling, pooled=pooled)
        _check(initial, maximum, largest_violation, learning_rate=learning_rate)
        self.learning_rate = learning_rate * (shape[0] if agent_scaling else 1)
        self.maximum = maximum
        self.pooled = pooled
        self.largest_violation = largest_violation
        self.register_buffer("values", th.full(shape, float(initial)))

    def update(self, violation: th.Tensor) -> None:
        """See :meth:`Multipliers.update`."""
        violation = _counted(violation, self.pooled, self.largest_violation)
        self.values.add_(_times(self.learning_rate, violation)).clamp_(0.0, self.maximum)


class PIDMultipliers(Multipliers):
    """PID-controlled multipliers (Stooke, Achiam, Abbeel 2020, Algorithm 2).

    Δ = J − l,  I ← max(0, I + k_i Δ),  λ = min(λ_max, max(0, k_p Δ + I + k_d max(0, J − J_prev)))

    The proportional term damps the oscillation of the integral, the derivative term brakes a
    rising cost early. With k_p = k_d = 0 this is :class:`GradientMultipliers` with η = k_i.

    :param shape: (K, M)
    :param kp: Gain of the violation
    :param ki: Gain of its sum over the rollouts
    :param kd: Gain of the increase of the cost since the last rollout
    :param initial: I, and λ, at the start
    :param maximum: λ_max, also the limit of the integral
    :param agent_scaling: See :class:`GradientMultipliers`; scales all three gains
    :param pooled: See :class:`GradientMultipliers`
    :param largest_violation: See :class:`GradientMultipliers`; Δ is at most this
    """

    integral: th.Tensor
    previous: th.Tensor

    def __init__(
        self,
        shape: tuple[int, int],
        kp: float = 0.05,
        ki: float = 0.01,
        kd: float = 0.05,
        initial: float = 0.0,
        maximum: float = math.inf,
        agent_scaling: bool = True,
        pooled: bool = False,
        largest_violation: float = math.inf,
    ):
        super().__init__(shape)
        _check_form(shape, agent_scaling=agent_scaling, pooled=pooled)
        _check(initial, maximum, largest_violation, kp=kp, ki=ki, kd=kd)
        scale = shape[0] if agent_scaling else 1
        self.kp, self.ki, self.kd = scale * kp, scale * ki, scale * kd
        self.maximum = maximum
        self.pooled = pooled
        self.largest_violation = largest_violation
        self.register_buffer("values", th.full(shape, float(initial)))
        self.register_buffer("integral", self.values.clone())
        self.register_buffer("previous", th.full(shape, math.inf))  # no increase at first

    def update(self, violation: th.Tensor) -> None:
        """See :meth:`Multipliers.update`."""
        violation = _counted(violation, self.pooled, self.largest_violation)
        increase = (violation - self.previous).nan_to_num(0.0).clamp_(min=0.0)
        self.previous.copy_(violation)
        self.integral.add_(_times(self.ki, violation)).clamp_(0.0, self.maximum)
        values = _times(self.kp, violation) + self.integral + self.kd * increase
        self.values.copy_(values.clamp_(0.0, self.maximum))


def _counted(violation: th.Tensor, pooled: bool, largest: float) -> th.Tensor:
    """What moves the multipliers: pooled, the mean over the parties for each; shape (K, M)."""
    if pooled:
        violation = violation.mean(dim=0, keepdim=True).expand_as(violation)
    return violation.clamp(max=largest)


def _times(gain: float, violation: th.Tensor) -> th.Tensor:
    """Their product; a gain of 0 ignores also a violation of −∞, which an infinite limit gives."""
    return gain * violation if gain > 0 else th.zeros_like(violation)


def _check_form(shape: Any, **flags: Any) -> None:
    sizes = shape if isinstance(shape, (tuple, list, th.Size)) else ()
    if len(sizes) != 2 or not all(isinstance(size, int) and size >= 0 for size in sizes):
        raise TypeError(f"multipliers: shape is {shape!r}; expected two whole numbers (K, M)")
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise TypeError(f"multipliers: {name} is {value!r}; expected True or False")


def _check(initial: float, maximum: float, largest_violation: float, **gains: float) -> None:
    bounds = {"initial": initial, "maximum": maximum, "largest_violation": largest_violation}
    for name, value in {**bounds, **gains}.items():
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        if not is_number or not value >= 0 or not fits_torch(value):
            raise ValueError(f"multipliers: {name} is {value!r}; expected a number of at least 0")
    if largest_violation == 0:
        raise ValueError("multipliers: largest_violation is 0; expected more, or λ never rises")
    if not math.isfinite(initial) or initial > maximum:
        raise ValueError(
            f"multipliers: initial is {initial!r}; expected a finite number of at most {maximum!r}"
        )
