"""What an update of all agents does to a team cost: predictions and bounds (Lemma 1).

Lemma 1 is false as printed for two or more agents (docs/paper.md, D16). docs/bounds.md has the
counterexample, and the proofs of T1, T1b, T3 and T4, which are named here.

π is the policy that collected a rollout, π̄ the policy after the update. A rollout has T steps of
W worlds of N agents with M costs; g are the weights of its steps (:func:`visit_weights`), qᵢ the
ratio π̄ⁱ/πⁱ of an agent's action (1 for an agent that takes no part), and q = Πᵢ qᵢ. Everything
called a cost is discounted and per episode, J = E Σₜ γᵗ cₜ. Divergences are in nats, KL(π ‖ π̄).

Pure numpy functions; nothing here knows about Stable-Baselines3.
"""

import numpy as np

MAX_LOG_RATIO = 20.0  # a larger ratio says nothing but that the sample is useless


def visit_weights(ages: np.ndarray, gamma: float) -> np.ndarray:
    """Weight of each step in an estimate of the discounted sum over an episode.

    g = γᵗ / episodes,   hence   Σ g f ≈ Σₜ γᵗ E fₜ

    The rollout should hold whole episodes.

    :param ages: Steps since the episode began, t, shape (T, W)
    :param gamma: Discount γ
    :return: g, shape (T, W)
    """
    episodes = np.count_nonzero(ages == 0)
    if episodes == 0:
        raise ValueError(
            f"No episode begins in these {ages.size} steps, and an estimate per episode needs at "
            "least one: collect whole episodes in a rollout (a larger n_steps)."
        )
    return gamma**ages / episodes


def visit_sum(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum over the visits of an episode, Σ g f; with f = c it is the cost J.

    :param values: f, shape (T, W, ...)
    :param weights: g, shape (T, W)
    :return: Shape (...)
    """
    return np.tensordot(weights, values, axes=2)


def visit_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean over the visited states, Σ g f / Σ g.

    :param values: f, shape (T, W, ...)
    :param weights: g, shape (T, W)
    :return: Shape (...)
    """
    return visit_sum(values, weights) / weights.sum()


# Predictions of the change of the cost


def joint_surrogate(
    log_ratios: np.ndarray, cost_advantages: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Predicted change of the cost when all agents act anew (the surrogate of T1).

    L(π̄) = Σₛ ρ(s) E_{u∼π̄}[A(s, u)] ≈ Σ g (q − 1) A

    The −1 changes no mean, since E_π[A] = 0, but it lowers the variance and removes what a critic's
    error adds to A in a state.

    :param log_ratios: log qᵢ, shape (T, W, N)
    :param cost_advantages: A of the team's costs, not standardized, shape (T, W, M)
    :param weights: g, shape (T, W)
    :return: Discounted cost per episode, shape (M,)
    """
    return visit_sum(_surplus(log_ratios.sum(-1))[..., None] * cost_advantages, weights)


def agent_surrogates(
    log_ratios: np.ndarray, cost_advantages: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Predicted change of the cost when a single agent acts anew, for each agent (Lemma 1).

    Lᵢ = L(π̄ⁱ) = Σₛ ρ(s) E_{u⁻ⁱ∼π, uⁱ∼π̄}[A(s, u)] ≈ Σ g (qᵢ − 1) A

    One of them says nothing about an update in which the others move as well.

    :param log_ratios: log qᵢ, shape (T, W, N)
    :param cost_advantages: A of the team's costs, not standardized, shape (T, W, M)
    :param weights: g, shape (T, W)
    :return: Discounted cost per episode, shape (N, M)
    """
    weighted = weights[..., None, None] * cost_advantages[..., None, :]
    return (_surplus(log_ratios)[..., None] * weighted).sum((0, 1))


def sum_surrogate(
    log_ratios: np.ndarray, cost_advantages: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Predicted change of the cost to first order (the surrogate of T3): Σᵢ Lᵢ.

    :param log_ratios: log qᵢ, shape (T, W, N)
    :param cost_advantages: A of the team's costs, not standardized, shape (T, W, M)
    :param weights: g, shape (T, W)
    :return: Discounted cost per episode, shape (M,)
    """
    return agent_surrogates(log_ratios, cost_advantages, weights).sum(0)


def interaction(
    log_ratios: np.ndarray, cost_advantages: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """What the agents' changes do together and none does alone: L(π̄) − Σᵢ Lᵢ.

    Of second order in the step; :func:`interaction_bound` limits it.

    :param log_ratios: log qᵢ, shape (T, W, N)
    :param cost_advantages: A of the team's costs, not standardized, shape (T, W, M)
    :param weights: g, shape (T, W)
    :return: Discounted cost per episode, shape (M,)
    """
    joint = joint_surrogate(log_ratios, cost_advantages, weights)
    return joint - sum_surrogate(log_ratios, cost_advantages, weights)


# How far the policy has moved


def categorical_kl(old_log_probs: np.ndarray, new_log_probs: np.ndarray) -> np.ndarray:
    """Exact KL divergence of two categorical policies: Σ_u π(u) log(π(u) / π̄(u)).

    :param old_log_probs: log π, shape (..., A); −inf for an action that is not available
    :param new_log_probs: log π̄, shape (..., A)
    :return: KL(π ‖ π̄), shape (...)
    """
    old_probs = np.exp(old_log_probs)
    log_ratio = np.zeros_like(old_probs)
    np.subtract(old_log_probs, new_log_probs, out=log_ratio, where=old_probs > 0)
    return np.maximum(0.0, (old_probs * log_ratio).sum(-1))  # not −1e-17 where nothing moved


def gaussian_kl(
    old_mean: np.ndarray, old_log_std: np.ndarray, new_mean: np.ndarray, new_log_std: np.ndarray
) -> np.ndarray:
    """Exact KL divergence of two diagonal Gaussian policies.

    Σ_d log(σ̄/σ) + (σ² + (μ − μ̄)²) / (2 σ̄²) − 1/2

    :param old_mean: μ, shape (..., A)
    :param old_log_std: log σ, broadcastable to (..., A)
    :param new_mean: μ̄, shape (..., A)
    :param new_log_std: log σ̄, broadcastable to (..., A)
    :return: KL(π ‖ π̄), shape (...)
    """
    moved = (np.exp(2 * old_log_std) + (old_mean - new_mean) ** 2) / (2 * np.exp(2 * new_log_std))
    return np.maximum(0.0, (new_log_std - old_log_std + moved - 0.5).sum(-1))


def sampled_kl(log_ratios: np.ndarray) -> np.ndarray:
    """Estimate of KL(π ‖ π̄) from an action of π: q − 1 − log q, never negative.

    Schulman's k3 estimator (http://joschu.net/blog/kl-approx.html), for policies without a closed
    form. Only its mean is a KL: the maximum over samples is not the maximum over states.

    :param log_ratios: log q, any shape
    :return: The same shape
    """
    return np.maximum(0.0, _surplus(log_ratios) - log_ratios)


def categorical_tv(old_log_probs: np.ndarray, new_log_probs: np.ndarray) -> np.ndarray:
    """Exact total variation of two categorical policies: ½ Σ_u |π(u) − π̄(u)|.

    :param old_log_probs: log π, shape (..., A)
    :param new_log_probs: log π̄, shape (..., A)
    :return: TV in [0, 1], shape (...)
    """
    return np.abs(np.exp(old_log_probs) - np.exp(new_log_probs)).sum(-1) / 2


def mean_tv(log_ratios: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Total variation of the joint policies in the mean visited state: ½ Σ g |q − 1| / Σ g.

    Unbiased, since TV = ½ E_π|q − 1|.

    :param log_ratios: log qᵢ, shape (T, W, N)
    :param weights: g, shape (T, W)
    :return: TV in [0, 1], scalar
    """
    return visit_mean(np.abs(_surplus(log_ratios.sum(-1))), weights) / 2


def effective_sample_size(log_ratios: np.ndarray) -> float:
    """Share of the samples that still speak about the new joint policy: (Σ q)² / (T W Σ q²).

    :param log_ratios: log qᵢ, shape (T, W, N)
    :return: In (0, 1]; if it is small, a few samples carry the joint surrogate
    """
    ratios = 1 + _surplus(log_ratios.sum(-1))
    return float(ratios.sum() ** 2 / (ratios.size * (ratios**2).sum()))


# Upper bounds of the cost of the new policy


def largest_advantage(max_cost: np.ndarray | float, gamma: float) -> np.ndarray | float:
    """A number that no |A| exceeds: ε = c_max / (1 − γ).

    :param max_cost: Largest cost of the team in one step, scalar or shape (M,); costs are not
        negative
    :param gamma: Discount γ
    :return: ε, discounted cost, shape of ``max_cost``
    """
    return max_cost / (1 - gamma)


def largest_expected_advantage(
    epsilon: np.ndarray | float,
    max_joint_kl: float,
    max_cost: np.ndarray | float,
    gamma: float,
) -> np.ndarray:
    """A number that |E_π̄ A| exceeds in no state (for T1b).

    min(2ε, c_max / (1 − γ)) · min(1, √(KL / 2))

    :param epsilon: ε ≥ |A|, scalar or shape (M,)
    :param max_joint_kl: Largest KL of the joint policies in a state, Σᵢ KLᵢ
    :param max_cost: Largest cost of the team in one step, scalar or shape (M,)
    :param gamma: Discount γ
    :return: Discounted cost, shape of ``epsilon``
    """
    span = np.minimum(2 * np.asarray(epsilon), largest_advantage(max_cost, gamma))
    return span * _largest_tv(max_joint_kl)


def joint_bound(
    cost: np.ndarray,
    surrogate: np.ndarray,
    max_kls: np.ndarray,
    epsilon: np.ndarray | float,
    gamma: float,
) -> np.ndarray:
    """Bound of the new cost by the joint surrogate; what Lemma 1 should say (T1).

    J(π̄) ≤ J(π) + L(π̄) + 2γε / (1 − γ)² Σᵢ KLᵢ

    :param cost: J(π), shape (M,)
    :param surrogate: L(π̄) of :func:`joint_surrogate`, shape (M,)
    :param max_kls: KLᵢ, each agent's largest KL in a state, shape (N,)
    :param epsilon: ε ≥ |A|, scalar or shape (M,)
    :param gamma: Discount γ
    :return: Discounted cost per episode, shape (M,)
    """
    return cost + surrogate + 2 * gamma * epsilon / (1 - gamma) ** 2 * np.sum(max_kls)


def average_bound(
    cost: np.ndarray,
    surrogate: np.ndarray,
    expected_advantage: np.ndarray | float,
    tv: np.ndarray | float,
    gamma: float,
) -> np.ndarray:
    """Bound by the joint surrogate with a mean divergence, after Achiam et al. 2017 (T1b).

    J(π̄) ≤ J(π) + L(π̄) + 2γ / (1 − γ)² maxₛ|E_π̄ A| E_{s∼d}[TV(s)]

    :param cost: J(π), shape (M,)
    :param surrogate: L(π̄) of :func:`joint_surrogate`, shape (M,)
    :param expected_advantage: maxₛ|E_π̄ A| or a number above it, scalar or shape (M,)
    :param tv: Total variation of the joint policies in the mean visited state (:func:`mean_tv`)
    :param gamma: Discount γ
    :return: Discounted cost per episode, shape (M,)
    """
    return cost + surrogate + 2 * gamma / (1 - gamma) ** 2 * expected_advantage * tv


def interaction_bound(
    tvs: np.ndarray, weights: np.ndarray, epsilon: np.ndarray | float
) -> np.ndarray:
    """Bound of |L(π̄) − Σᵢ Lᵢ|, attained by a cost that only a disagreement causes (T3).

    2ε Σₛ ρ(s) [(Σᵢ TVᵢ(s))² − Σᵢ TVᵢ(s)²]

    :param tvs: TVᵢ, each agent's total variation in each visited state, shape (T, W, N)
    :param weights: g, shape (T, W)
    :param epsilon: ε ≥ |A|, scalar or shape (M,)
    :return: Discounted cost per episode, shape of ``epsilon``
    """
    return 2 * epsilon * visit_sum(tvs.sum(-1) ** 2 - (tvs**2).sum(-1), weights)


def sum_bound(
    cost: np.ndarray,
    surrogate: np.ndarray,
    max_kls: np.ndarray,
    epsilon: np.ndarray | float,
    gamma: float,
) -> np.ndarray:
    """Bound of the new cost by the sum of the agents' surrogates (T3).

    J(π̄) ≤ J(π) + Σᵢ Lᵢ + [2γε / (1 − γ)² + (N − 1) ε / (1 − γ)] Σᵢ KLᵢ

    :param cost: J(π), shape (M,)
    :param surrogate: Σᵢ Lᵢ of :func:`sum_surrogate`, shape (M,)
    :param max_kls: KLᵢ, each agent's largest KL in a state, shape (N,)
    :param epsilon: ε ≥ |A|, scalar or shape (M,)
    :param gamma: Discount γ
    :return: Discounted cost per episode, shape (M,)
    """
    together = (len(max_kls) - 1) * epsilon / (1 - gamma) * np.sum(max_kls)
    return joint_bound(cost, surrogate, max_kls, epsilon, gamma) + together


def agent_bounds(
    cost: np.ndarray,
    surrogates: np.ndarray,
    max_kls: np.ndarray,
    epsilon: np.ndarray | float,
    gamma: float,
) -> np.ndarray:
    """Bounds of the new cost by one agent's surrogate, with the term Lemma 1 lacks (T4).

    J(π̄) ≤ J(π) + Lᵢ + 2γε / (1 − γ)² Σₕ KLₕ + 2ε / (1 − γ) Σ_{h≠i} min(1, √(KLₕ / 2))

    :param cost: J(π), shape (M,)
    :param surrogates: Lᵢ of :func:`agent_surrogates`, shape (N, M)
    :param max_kls: KLₕ, each agent's largest KL in a state, shape (N,)
    :param epsilon: ε ≥ |A|, scalar or shape (M,)
    :param gamma: Discount γ
    :return: Discounted cost per episode, one bound for each agent, shape (N, M)
    """
    tvs = _largest_tv(max_kls)
    others = (tvs.sum() - tvs)[:, None]
    return (
        joint_bound(cost, surrogates, max_kls, epsilon, gamma) + 2 * epsilon / (1 - gamma) * others
    )


def printed_not_a_bound(
    cost: np.ndarray,
    surrogates: np.ndarray,
    max_kls: np.ndarray,
    epsilon: np.ndarray | float,
    gamma: float,
) -> np.ndarray:
    """Right-hand side of Lemma 1 as printed. The new cost may exceed it.

    J(π) + Lᵢ + 4γε / (1 − γ)² Σₕ KLₕ

    True if agent i moves alone, false otherwise (docs/paper.md, D16).

    :param cost: J(π), shape (M,)
    :param surrogates: Lᵢ of :func:`agent_surrogates`, shape (N, M)
    :param max_kls: KLₕ, each agent's largest KL in a state, shape (N,)
    :param epsilon: ε ≥ |A|, scalar or shape (M,)
    :param gamma: Discount γ
    :return: Discounted cost per episode, one number for each agent, shape (N, M)
    """
    return cost + surrogates + 4 * gamma * epsilon / (1 - gamma) ** 2 * np.sum(max_kls)


def _surplus(log_ratio: np.ndarray) -> np.ndarray:
    """The surplus q − 1 of a ratio, in double precision and without overflow, any shape."""
    return np.expm1(np.minimum(log_ratio, MAX_LOG_RATIO), dtype=np.float64)


def _largest_tv(kl: np.ndarray | float) -> np.ndarray:
    """Largest total variation that a KL divergence allows (Pinsker): min(1, √(KL / 2))."""
    return np.minimum(1.0, np.sqrt(np.asarray(kl) / 2))
