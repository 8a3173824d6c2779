"""Discounted returns and advantages, for the reward and for each cost alike (Eqs. 1, 2, 4, 5).

Pure numpy functions; nothing here knows about Stable-Baselines3.
"""

import numpy as np


def gae(
    rewards: np.ndarray,
    values: np.ndarray,
    last_values: np.ndarray,
    dones: np.ndarray,
    gamma: float,
    gae_lambda: float,
) -> np.ndarray:
    """Generalized advantage estimate of a signal (Schulman et al. 2016, and the paper's Eq. 5).

    δₜ = rₜ + γ (1 − dₜ) Vₜ₊₁ − Vₜ,   Aₜ = δₜ + γλ (1 − dₜ) Aₜ₊₁

    The bootstrap of a time-out, γ V(terminal), is expected to be added to ``rewards`` already,
    as Stable-Baselines3 does.

    :param rewards: Rewards, or costs, shape (T, ...)
    :param values: V of the state in which each step started, shape (T, ...)
    :param last_values: V of the state after the last step, shape (...)
    :param dones: True where the episode ended with this step, broadcastable to (T, ...)
    :param gamma: Discount γ
    :param gae_lambda: Trade-off λ between bias (0) and variance (1)
    :return: Advantages, shape (T, ...); advantages + values are the TD(λ) targets of the critic
    """
    advantages = np.zeros_like(rewards)
    alive = 1.0 - dones.astype(rewards.dtype)
    next_values, next_advantages = last_values, np.zeros_like(last_values)
    with np.errstate(over="ignore", invalid="ignore"):  # learners stop at what is not finite
        for t in reversed(range(len(rewards))):
            delta = rewards[t] + gamma * alive[t] * next_values - values[t]
            advantages[t] = delta + gamma * gae_lambda * alive[t] * next_advantages
            next_values, next_advantages = values[t], advantages[t]
    return advantages
