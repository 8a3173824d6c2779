"""The terms of the policy and critic objectives (Eqs. 6, 8), as pure functions of tensors."""

import torch as th


def penalized_advantages(
    advantages: th.Tensor, cost_advantages: th.Tensor, multipliers: th.Tensor
) -> th.Tensor:
    """Advantage of the Lagrangian: reward minus the priced costs (Eqs. 6, 8).

    Ã = A_r − Σⱼ λⱼ A_cⱼ

    The paper's Eq. 8 prints a plus sign and the bracket λ (J − l); Eq. 6 fixes the sign, and the
    bracket has no gradient (docs/paper.md, D1 and D2).

    :param advantages: A_r of every agent, shape (..., N)
    :param cost_advantages: A_c, shape (..., K, M); K is 1 for team constraints, N for individual
    :param multipliers: λ, shape (K, M)
    :return: Ã of every agent, shape (..., N)
    """
    return advantages - (cost_advantages * multipliers).sum(dim=-1)


def normalize(advantages: th.Tensor) -> th.Tensor:
    """Standardize a minibatch of advantages: (A − mean) / (sd + 1e-8).

    :param advantages: Any shape
    :return: The same shape; unchanged if there is a single number (it has no standard deviation)
    """
    if advantages.numel() == 1:
        return advantages
    spread = advantages.std()
    if not th.isfinite(spread):  # their squares are beyond float32
        advantages = advantages / advantages.abs().max()
        spread = advantages.std()
    return (advantages - advantages.mean()) / (spread + 1e-8)


def policy_loss(ratio: th.Tensor, advantages: th.Tensor, clip_range: float) -> th.Tensor:
    """Clipped surrogate to be minimized (Eq. 8).

    L = −E[min(q Ã, clip(q, 1 − ε, 1 + ε) Ã)]

    The penalty stands inside the clip, as part of Ã (docs/paper.md, D3).

    :param ratio: q = π(u|o) / π_old(u|o), any shape
    :param advantages: Ã, same shape
    :param clip_range: ε
    :return: Scalar
    """
    clipped = advantages * th.clamp(ratio, 1 - clip_range, 1 + clip_range)
    return -th.min(advantages * ratio, clipped).mean()


def value_loss(
    values: th.Tensor,
    returns: th.Tensor,
    old_values: th.Tensor | None = None,
    clip_range: float | None = None,
) -> th.Tensor:
    """Mean squared error of a critic (Alg. 2 l. 14, 16), optionally with clipped predictions.

    :param values: Predictions, any shape
    :param returns: Targets, same shape
    :param old_values: Predictions at the time of the rollout; needed with ``clip_range``
    :param clip_range: Largest change of a prediction that still counts; None does not clip
    :return: Scalar
    """
    if clip_range is not None:
        assert old_values is not None, "clipping a value needs the value of the rollout"
        values = old_values + th.clamp(values - old_values, -clip_range, clip_range)
    return th.nn.functional.mse_loss(values, returns)


def approx_kl(log_ratio: th.Tensor) -> th.Tensor:
    """Estimate of KL(old ‖ new) from samples of the old policy: E[q − 1 − log q].

    Schulman's k3 estimator, never negative (http://joschu.net/blog/kl-approx.html).

    :param log_ratio: log q, any shape
    :return: Scalar
    """
    return (th.exp(log_ratio) - 1 - log_ratio).mean()


def clip_fraction(ratio: th.Tensor, clip_range: float) -> th.Tensor:
    """Share of the samples whose ratio has left [1 − ε, 1 + ε].

    :param ratio: q, any shape
    :param clip_range: ε
    :return: Scalar in [0, 1]
    """
    return (th.abs(ratio - 1) > clip_range).float().mean()
