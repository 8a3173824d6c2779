"""Dec-MDPs small enough to enumerate: exact costs, visits, advantages, divergences.

B problems of equal size are solved at once. S states, N agents with A actions each, U = Aᴺ joint
actions, M costs. A policy is an array of shape (B, N, S, A) with strictly positive entries.
"""

from typing import NamedTuple

import numpy as np


class Problems(NamedTuple):
    start: np.ndarray  # (B, S)
    transitions: np.ndarray  # (B, S, U, S)
    costs: np.ndarray  # (B, S, U, M), in [0, 1]
    gamma: float


class Solution(NamedTuple):
    cost: np.ndarray  # J, (B, M)
    visits: np.ndarray  # ρ, (B, S), sums to 1 / (1 − γ)
    advantages: np.ndarray  # A, (B, S, U, M)

    @property
    def epsilon(self):
        return np.abs(self.advantages).max((1, 2))  # (B, M)


def joint_actions(n_agents, n_actions):
    """Action of each agent in each joint action, (N, U)."""
    return np.indices((n_actions,) * n_agents).reshape(n_agents, -1)


def joint_policy(policy):
    """Product of the agents' policies, (B, S, U)."""
    product = np.ones((*policy[:, 0].shape[:2], 1))
    for agent in range(policy.shape[1]):
        product = (product[..., None] * policy[:, agent, :, None, :]).reshape(
            *product.shape[:2], -1
        )
    return product


def solve(problems, joint):
    """Exact solution for joint policies of shape (B, S, U)."""
    start, transitions, costs, gamma = problems
    identity = np.eye(start.shape[-1])
    step = identity - gamma * np.einsum("bsu,bsuz->bsz", joint, transitions)
    values = np.linalg.solve(step, np.einsum("bsu,bsum->bsm", joint, costs))
    visits = np.linalg.solve(step.swapaxes(1, 2), start[..., None])[..., 0]
    action_values = costs + gamma * np.einsum("bsuz,bzm->bsum", transitions, values)
    advantages = action_values - values[:, :, None]
    return Solution(np.einsum("bs,bsm->bm", start, values), visits, advantages)


def surrogate(solution, joint):
    """Σₛ ρ(s) Σ_u π̄(u|s) A(s, u) for any joint policy, (B, M)."""
    return np.einsum("bs,bsu,bsum->bm", solution.visits, joint, solution.advantages)


def moved_alone(policy, new_policy, agent):
    """The policy in which only this agent is new."""
    mixed = policy.copy()
    mixed[:, agent] = new_policy[:, agent]
    return mixed


def log_ratios(policy, new_policy):
    """log of the agents' ratios in every state and joint action, (B, S, U, N)."""
    actions = joint_actions(policy.shape[1], policy.shape[3])
    ratios = [
        np.log(new_policy[:, i, :, actions[i]] / policy[:, i, :, actions[i]])
        for i in range(policy.shape[1])
    ]
    return np.stack(ratios, axis=-1).transpose(1, 2, 0, 3)


def random_problems(rng, count, n_states, n_agents, n_actions, gamma, n_costs=2):
    """Random transitions and 0/1 costs."""
    joint = n_actions**n_agents
    return Problems(
        start=rng.dirichlet(np.ones(n_states), count),
        transitions=rng.dirichlet(np.full(n_states, 0.3), (count, n_states, joint)),
        costs=rng.integers(0, 2, (count, n_states, joint, n_costs)).astype(float),
        gamma=gamma,
    )


def random_policy(rng, count, n_agents, n_states, n_actions):
    """Positive everywhere, so that ratios and KL divergences are finite."""
    policy = rng.dirichlet(np.ones(n_actions), (count, n_agents, n_states))
    return 0.98 * policy + 0.02 / n_actions


def worst_reply(solution, policy):
    """Policy that plays, for each agent, the action that raises the first cost most."""
    actions = joint_actions(policy.shape[1], policy.shape[3])
    weights = joint_policy(policy) * solution.advantages[..., 0]
    worst = np.empty_like(policy)
    for agent in range(policy.shape[1]):
        chosen = actions[agent][:, None] == np.arange(policy.shape[3])  # (U, A)
        gain = weights @ chosen / policy[:, agent]
        worst[:, agent] = gain == gain.max(-1, keepdims=True)
    return worst / worst.sum(-1, keepdims=True)
