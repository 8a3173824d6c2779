"""The objective of a minibatch and its gradient at the outputs of the networks (Eq. 8, Alg. 2).

The formulas stand in ``losses.py``; :func:`reference` is nothing else, on any device and in any
precision. :func:`objective` gives the same numbers on a CPU by two compiled loops, where torch
needs sixty operations of 3 to 20 µs, forward and back.

A minibatch may be computed in parts. Every mean is one over the whole minibatch, of which a part
holds a share: what parts give, added up, is what the whole would give.

Shapes: B team steps, N agents, K constrained parties (1 or N), M constraints.
"""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from numba import njit

from sb3_e2c.losses import approx_kl, clip_fraction, policy_loss, value_loss


class Weights(NamedTuple):
    """Settings of the objective."""

    clip_range: float  # ε of Eq. 8
    clip_range_vf: float | None
    ent_coef: float
    vf_coef: float


class Outputs(NamedTuple):
    """What the networks say about B team steps, or gradients there; the shape stands behind it."""

    log_prob: th.Tensor  # (B, N)
    entropy: th.Tensor  # (B, N)
    values: th.Tensor  # (B, N)
    cost_values: th.Tensor  # (B, K, M)


class Targets(NamedTuple):
    """With what the objective compares them."""

    old_log_prob: th.Tensor  # (B, N)
    advantages: th.Tensor  # (B, N), normalized if they shall be
    old_values: th.Tensor  # (B, N)
    returns: th.Tensor  # (B, N)
    old_cost_values: th.Tensor  # (B, K, M)
    cost_returns: th.Tensor  # (B, K, M)


class Terms(NamedTuple):
    """The terms of the objective, and what is logged about them: shares of means."""

    policy_gradient_loss: float
    value_loss: float
    cost_value_loss: float  # the sum over the constraints
    entropy_loss: float
    clip_fraction: float
    approx_kl: float

    def loss(self, weights: Weights) -> float:
        """The objective, to be minimized."""
        values = self.value_loss + self.cost_value_loss
        actor = self.policy_gradient_loss + weights.ent_coef * self.entropy_loss
        return actor + weights.vf_coef * values


def objective(
    outputs: Outputs, targets: Targets, weights: Weights, share: float = 1.0
) -> tuple[Terms, Outputs]:
    """The objective of a part of a minibatch, and its gradient.

    :param outputs: What the networks say; no gradients are recorded
    :param targets: With what to compare it
    :param weights: Settings
    :param share: Share of the minibatch that the part holds
    :return: The terms, and the gradient of the objective with respect to every output
    """
    if any(each.device.type != "cpu" or each.dtype != th.float32 for each in outputs):
        return reference(outputs, targets, weights, share)
    gradients = Outputs(*(th.empty(each.shape) for each in outputs))
    gradients.entropy.fill_(-weights.ent_coef * _per_entry(share, outputs.entropy))
    actor, kl, clipped = _actor_part(outputs, targets, weights, share, gradients.log_prob)
    value = _critic_part(
        outputs.values,
        targets.returns,
        targets.old_values,
        _per_entry(share, outputs.values),
        weights,
        gradients.values,
    )
    n_constraints = outputs.cost_values.shape[-1]
    cost_value = _critic_part(
        outputs.cost_values,
        targets.cost_returns,
        targets.old_cost_values,
        _per_entry(share, outputs.cost_values) * n_constraints,  # means of each are summed
        weights,
        gradients.cost_values,
    )
    entropy = -outputs.entropy.mean().item() * share
    return Terms(actor, value, cost_value, entropy, clipped, kl), gradients


def reference(
    outputs: Outputs, targets: Targets, weights: Weights, share: float = 1.0
) -> tuple[Terms, Outputs]:
    """The same by the formulas of ``losses.py`` and automatic differentiation.

    See :func:`objective`.
    """
    leaves = Outputs(*(each.detach().requires_grad_() for each in outputs))
    with th.enable_grad():
        log_ratio = leaves.log_prob - targets.old_log_prob
        ratio = th.exp(log_ratio)  # q of Eq. 8
        actor = policy_loss(ratio, targets.advantages, weights.clip_range)  # l. 13, Eq. 8
        clip = weights.clip_range_vf
        value = value_loss(leaves.values, targets.returns, targets.old_values, clip)  # l. 14
        cost_value = th.zeros_like(value)
        costs = (leaves.cost_values, targets.cost_returns, targets.old_cost_values)
        for new, target, old in zip(*(each.unbind(-1) for each in costs), strict=True):
            cost_value = cost_value + value_loss(new, target, old, clip)  # l. 16
        terms = [share * each for each in (actor, value, cost_value, -leaves.entropy.mean())]
        loss: Any = Terms(*terms, 0.0, 0.0).loss(weights)  # type: ignore[arg-type, call-arg]
        gradients = th.autograd.grad(loss, leaves, materialize_grads=True)
    with th.no_grad():
        noted = (clip_fraction(ratio, weights.clip_range), approx_kl(log_ratio))
    numbers = [each.item() for each in (*terms, *(share * each for each in noted))]
    return Terms(*numbers), Outputs(*gradients)


def _per_entry(share: float, output: th.Tensor) -> float:
    """Weight of one number in a mean over the whole minibatch."""
    return share / max(output.numel(), 1)


def _actor_part(
    outputs: Outputs, targets: Targets, weights: Weights, share: float, gradient: th.Tensor
) -> tuple[float, float, float]:
    """Surrogate, KL and clip fraction; see :func:`_surrogate`."""
    clip, per_entry = float(weights.clip_range), _per_entry(share, outputs.log_prob)
    tensors = (outputs.log_prob, targets.old_log_prob, targets.advantages, gradient)
    actor, kl, clipped = _surrogate(clip, np.float32(per_entry), *map(_flat, tensors))
    return actor * per_entry, kl * per_entry, clipped * per_entry


def _critic_part(
    values: th.Tensor,
    targets: th.Tensor,
    old_values: th.Tensor,
    per_entry: float,
    weights: Weights,
    gradient: th.Tensor,
) -> float:
    """Loss of critics; see :func:`_regression`."""
    clip = weights.clip_range_vf
    slope = np.float32(2 * weights.vf_coef * per_entry)
    most = np.float32(np.inf if clip is None else clip)
    tensors = (values, targets, old_values, gradient)
    return _regression(most, slope, *map(_flat, tensors)) * per_entry


def _flat(tensor: th.Tensor) -> np.ndarray:
    return tensor.reshape(-1).numpy()


@njit(cache=True, error_model="numpy", nogil=True)
def _surrogate(clip_range, per_entry, log_prob, old, advantages, gradient):
    """``losses.policy_loss``, ``approx_kl`` and ``clip_fraction`` of n actions.

    min(q Ã, clip(q) Ã) with q = exp(log π − log π_old): where the clipped product is the smaller
    one it does not depend on π, else ∂(−q Ã) / ∂ log π = −q Ã.

    :param clip_range: ε
    :param per_entry: factor on the gradient
    :param log_prob: log π, shape (n,)
    :param old: log π_old, shape (n,)
    :param advantages: Ã, shape (n,)
    :param gradient: the result, with respect to log π, shape (n,)
    :return: sums of the loss, of q − 1 − log q, and of the clipped ratios
    """
    one, most = np.float32(1.0), np.float32(clip_range)
    low, high = np.float32(1.0 - clip_range), np.float32(1.0 + clip_range)
    loss, kl, clipped = 0.0, 0.0, 0
    for i in range(len(log_prob)):
        log_ratio = log_prob[i] - old[i]
        q = np.exp(log_ratio)
        free = advantages[i] * q
        bounded = advantages[i] * min(max(q, low), high)
        if bounded < free:
            loss -= bounded
            gradient[i] = 0.0
        else:  # also where a product is no number, which the loss then shows
            loss -= free
            gradient[i] = -free * per_entry
        kl += q - one - log_ratio
        clipped += abs(q - one) > most
    return loss, kl, clipped


@njit(cache=True, error_model="numpy", nogil=True)
def _regression(most, slope, values, targets, old, gradient):
    """``losses.value_loss`` of n predictions: squared errors, and their gradients 2 (v − target).

    :param most: largest change that counts, v as ``old + clip(v − old)``; infinite: no clip
    :param slope: factor on the gradient, with the 2
    :param values: v, shape (n,)
    :param targets: shape (n,)
    :param old: v of the rollout, shape (n,)
    :param gradient: the result, shape (n,)
    :return: sum of the squared errors
    """
    total = 0.0
    for i in range(len(values)):
        change = values[i] - old[i]
        if abs(change) > most:
            error = old[i] + (most if change > 0 else -most) - targets[i]
            gradient[i] = 0.0
        else:  # in this form what is no number stays none
            error = change + old[i] - targets[i]
            gradient[i] = slope * error
        total += error * error
    return total
