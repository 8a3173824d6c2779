"""The rollout of a team, stored by world, and its minibatches of whole team steps.

Shapes: T steps, W worlds, N agents, S = W·N slots, B team steps, D observation size, A action
size, G size of the critics' extra state, K constrained parties (1 or N), M constraints.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_e2c.losses import penalized_advantages
from sb3_e2c.policies import StepEvaluation, TeamPolicy
from sb3_e2c.returns import gae
from sb3_e2c.sequences import (
    Cut,
    Memory,
    Sequences,
    alternate,
    cut_at_ends,
    initial_memory,
    packed_rows,
    random_groups,
)


class TeamSamples(NamedTuple):
    """B team steps of a rollout; each field has the shape behind it."""

    observations: th.Tensor  # (B, N, D)
    actions: th.Tensor  # (B, N, A)
    critic_states: th.Tensor  # (B, G)
    old_log_prob: th.Tensor  # (B, N)
    advantages: th.Tensor  # (B, N), penalized by the costs
    old_values: th.Tensor  # (B, N), outputs of the critic before the update
    returns: th.Tensor  # (B, N), in units of the value normalizer
    old_cost_values: th.Tensor  # (B, K, M), outputs of the cost critics before the update
    cost_returns: th.Tensor  # (B, K, M), in units of the cost value normalizer


class Timeout(NamedTuple):
    """Episodes that a time limit cut off in one step."""

    step: int
    worlds: np.ndarray  # indices of w worlds
    observations: np.ndarray  # (w, N, D), the last ones of these episodes
    critic_states: np.ndarray  # (w, G)


class TeamRolloutBuffer(RolloutBuffer):
    """Rollout buffer with costs, for critics that see a whole team.

    While collecting, only what the environment says is stored. ``finish`` then evaluates all
    networks on the whole rollout at once, which is several times faster than step by step.

    :param n_agents: N
    :param n_parties: K
    :param n_constraints: M
    :param critic_state_dim: G
    :param cost_gamma: Discount of the costs
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        gae_lambda: float = 1,
        gamma: float = 0.99,
        n_envs: int = 1,
        n_agents: int = 1,
        n_parties: int = 1,
        n_constraints: int = 0,
        critic_state_dim: int = 0,
        cost_gamma: float = 0.99,
    ):
        self.n_agents, self.n_worlds = n_agents, n_envs // n_agents
        self.party_shape = (n_parties, n_constraints)
        self.initial: Memory | None = None
        self.critic_state_dim = critic_state_dim
        self.cost_gamma = cost_gamma
        super().__init__(
            buffer_size, observation_space, action_space, device, gae_lambda, gamma, n_envs
        )
        self._allocate()

    def _allocate(self) -> None:
        slots = (self.buffer_size, self.n_envs)
        parties = (self.buffer_size, self.n_worlds, *self.party_shape)
        worlds = (self.buffer_size, self.n_worlds)
        self.observations = np.zeros((*slots, *self.obs_shape), self.observation_space.dtype)
        self.actions = np.zeros((*slots, self.action_dim), self.action_space.dtype)
        self.rewards, self.values, self.log_probs, self.advantages, self.returns = (
            np.zeros(slots, np.float32) for _ in range(5)
        )
        self.costs, self.cost_values, self.cost_advantages, self.cost_returns = (
            np.zeros(parties, np.float32) for _ in range(4)
        )
        self.critic_states = np.zeros((*worlds, self.critic_state_dim), np.float32)
        self.dones = np.zeros(worlds, bool)
        self.episode_starts = np.zeros(slots, np.float32)

    def reset(self, initial: Memory | None = None) -> None:
        """Forget the last rollout; the arrays stay and are overwritten.

        :param initial: Hidden states of all worlds before the next rollout; None: the policy is
            not recurrent
        """
        self.pos, self.full = 0, False
        self.timeouts: list[Timeout] = []
        self.initial = initial

    def add(  # type: ignore[override]
        self,
        obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        episode_start: np.ndarray,
        costs: np.ndarray,
        critic_states: np.ndarray,
        dones: np.ndarray,
        timeout: Timeout | None,
    ) -> None:
        """Store one step of all slots.

        :param obs: Observations on which the actions were chosen, shape (S, D)
        :param action: Shape (S, A) or (S,)
        :param reward: Shape (S,)
        :param episode_start: Whether the episode started with this step, shape (S,)
        :param costs: Costs of the constrained parties, shape (W, K, M)
        :param critic_states: Extra state of the critics at ``obs``, shape (W, G)
        :param dones: Whether the episode ended with this step, shape (W,)
        :param timeout: Episodes that ended by their time limit
        """
        self.observations[self.pos] = obs.reshape(self.n_envs, *self.obs_shape)
        self.actions[self.pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos] = reward
        self.episode_starts[self.pos] = episode_start
        self.costs[self.pos] = costs
        self.critic_states[self.pos] = critic_states
        self.dones[self.pos] = dones
        if timeout is not None:
            self.timeouts.append(timeout)
        self.pos += 1
        self.full = self.pos == self.buffer_size

    def finish(
        self, policy: TeamPolicy, last_obs: np.ndarray, last_critic_states: np.ndarray
    ) -> tuple[th.Tensor, th.Tensor]:
        """Evaluate the networks on the rollout and compute all advantages (Alg. 2 l. 12).

        :param policy: The networks that collected the rollout
        :param last_obs: Observations after the last step, shape (S, D)
        :param last_critic_states: Extra state of the critics there, shape (W, G)
        :return: Hidden states of the critics after the last step, shapes (W, 1, H) and (W, K, H)
        """
        with th.no_grad():
            evaluation = self._evaluate(policy)
            values, cost_values = policy.denormalize(evaluation.values, evaluation.cost_values)
            latents = (evaluation.value_latent, evaluation.cost_latent)
            self._bootstrap_timeouts(policy, latents)
            final = tuple(latent[-self.n_worlds :] for latent in latents)
            last = self._values(policy, last_obs, last_critic_states, final)
        self.log_probs[:] = evaluation.log_prob.cpu().numpy().reshape(self.log_probs.shape)
        self.values[:] = values.cpu().numpy().reshape(self.values.shape)
        self.cost_values[:] = cost_values.cpu().numpy().reshape(self.cost_values.shape)
        self.compute_returns_and_advantage(*last)
        self.old_outputs = (evaluation.values, evaluation.cost_values)
        return final[0], final[1]

    def _evaluate(self, policy: TeamPolicy) -> StepEvaluation:
        """Evaluate all networks on the whole rollout, in the order of its rows (T·W)."""
        inputs = self._network_inputs()
        if self.initial is None:
            return policy.evaluate_steps(*inputs)
        rows, sequences = self._pack(cut_at_ends(self.dones), self.initial)
        observations, actions, critic_states = (each[rows] for each in inputs)
        packed = policy.evaluate_steps(observations, actions, critic_states, sequences)
        back = th.empty_like(rows)
        back[rows] = th.arange(len(rows), device=self.device)
        return StepEvaluation(*(each[back] for each in packed))

    def _pack(self, cut: Cut, initial: Memory) -> tuple[th.Tensor, Sequences]:
        """Rows of the rollout that make some sequences, shape (B,), and the sequences."""
        rows, batch_sizes = packed_rows(cut, self.n_worlds)
        sequences = Sequences(th.from_numpy(batch_sizes), initial_memory(cut, initial))
        return th.from_numpy(rows).to(self.device), sequences

    def compute_returns_and_advantage(  # type: ignore[override]
        self, last_values: np.ndarray, last_cost_values: np.ndarray
    ) -> None:
        """GAE of the reward and of every cost.

        :param last_values: Values after the last step, shape (W, N)
        :param last_cost_values: Shape (W, K, M)
        """
        slot_dones = np.repeat(self.dones, self.n_agents, axis=1)
        self.advantages[:] = gae(
            self.rewards, self.values, last_values.ravel(), slot_dones, self.gamma, self.gae_lambda
        )
        self.returns[:] = self.advantages + self.values
        party_dones = self.dones[..., None, None]
        self.cost_advantages[:] = gae(
            self.costs,
            self.cost_values,
            last_cost_values,
            party_dones,
            self.cost_gamma,
            self.gae_lambda,
        )
        self.cost_returns[:] = self.cost_advantages + self.cost_values

    def _bootstrap_timeouts(self, policy: TeamPolicy, latents: tuple[th.Tensor, ...]) -> None:
        """A time limit is no end: add the discounted value of what would have followed.

        :param policy: The networks
        :param latents: Last hidden layers of both critics on the rollout, shape (T·W, ...)
        """
        rewards = self.rewards.reshape(self.buffer_size, self.n_worlds, self.n_agents)
        for step, worlds, observations, critic_states in self.timeouts:
            before = tuple(latent[step * self.n_worlds + worlds] for latent in latents)
            values, cost_values = self._values(policy, observations, critic_states, before)
            rewards[step, worlds] += self.gamma * values
            self.costs[step, worlds] += self.cost_gamma * cost_values

    def _values(
        self,
        policy: TeamPolicy,
        observations: np.ndarray,
        critic_states: np.ndarray,
        latents: tuple[th.Tensor, ...],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values of observations that follow on steps of the rollout.

        :param policy: The networks
        :param observations: w teams, shape (w·N, D)
        :param critic_states: Shape (w, G)
        :param latents: Last hidden layers of both critics in the step before, shape (w, ...)
        :return: Shapes (w, N) and (w, K, M)
        """
        teams = self.to_torch(observations).reshape(-1, self.n_agents, *self.obs_shape)
        sequences = None
        if self.initial is not None:
            batch_sizes = th.tensor([len(teams)])
            sequences = Sequences(batch_sizes, Memory(latents[0], *latents))
        values, cost_values = policy.team_values(teams, self.to_torch(critic_states), sequences)
        return values.cpu().numpy(), cost_values.cpu().numpy()

    def _network_inputs(self) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Observations (T·W, N, D), actions (T·W, N, A), critic states (T·W, G); views on a CPU."""
        teams = (self.buffer_size * self.n_worlds, self.n_agents)
        return (
            self._tensor(self.observations.reshape(*teams, *self.obs_shape)),
            self._tensor(self.actions.reshape(*teams, self.action_dim)),
            self._tensor(self.critic_states.reshape(teams[0], -1)),
        )

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).to(self.device)

    def samples(
        self, policy: TeamPolicy, multipliers: th.Tensor, normalize_values: bool
    ) -> TeamSamples:
        """The whole rollout, ready for the update.

        :param policy: Owner of the value normalizers
        :param multipliers: λ, shape (K, M)
        :param normalize_values: Whether to standardize the critics' targets
        :return: B = T·W team steps
        """
        observations, actions, critic_states = self._network_inputs()
        teams = (len(observations), self.n_agents)
        parties = (len(observations), *self.party_shape)
        returns, log_prob, advantages = (
            self._tensor(a.reshape(teams)) for a in (self.returns, self.log_probs, self.advantages)
        )
        cost_returns, cost_advantages = (
            self._tensor(a.reshape(parties)) for a in (self.cost_returns, self.cost_advantages)
        )
        old_values, old_cost_values = self.old_outputs
        if normalize_values:
            policy.value_norm.update(returns[..., None])
            policy.cost_value_norm.update(cost_returns)
        return TeamSamples(
            observations=observations,
            actions=actions,
            critic_states=critic_states,
            old_log_prob=log_prob,
            advantages=penalized_advantages(advantages, cost_advantages, multipliers),
            old_values=old_values,
            returns=policy.value_norm.normalize(returns),
            old_cost_values=old_cost_values,
            cost_returns=policy.cost_value_norm.normalize(cost_returns),
        )

    def get(self, batch_size: int | None = None) -> Any:
        """Not used: minibatches of rows would tear teams apart; see :meth:`minibatches`."""
        raise NotImplementedError("a team rollout is read with samples() and minibatches()")

    def minibatches(
        self, samples: TeamSamples, n_team_steps: int
    ) -> Iterator[tuple[TeamSamples, Sequences | None]]:
        """Divide a rollout into random minibatches of nearly equal size.

        :param samples: The rollout
        :param n_team_steps: Largest number of team steps in a minibatch; about that number in a
            recurrent rollout, whose minibatches are made of whole sequences
        :return: Minibatches that together hold every team step once, and their sequences
        """
        if self.initial is None:
            yield from ((batch, None) for batch in _random_steps(samples, n_team_steps))
            return
        for group in random_groups(cut_at_ends(self.dones), n_team_steps):
            rows, sequences = self._pack(group, self.initial)
            yield _take(samples, rows), sequences


def _random_steps(samples: TeamSamples, n_team_steps: int) -> Iterator[TeamSamples]:
    """Random minibatches of single team steps; see :meth:`TeamRolloutBuffer.minibatches`."""
    total = len(samples.observations)
    n_batches = -(-total // n_team_steps)
    if n_batches == 1:
        yield samples
        return
    for indices in np.array_split(np.random.permutation(total), n_batches):
        chosen = th.from_numpy(indices).to(samples.observations.device)
        yield _take(samples, chosen)


def halves(
    samples: TeamSamples, sequences: Sequences | None
) -> list[tuple[TeamSamples, Sequences | None]]:
    """Divide a minibatch into two of nearly equal size, always in the same way.

    :param samples: The minibatch
    :param sequences: Its sequences, of which every other goes to the second half; if there are
        none, the halves are views of the minibatch
    :return: Two halves, or the whole if it is a single step or sequence
    """
    if sequences is not None:
        return [(_take(samples, rows), half) for rows, half in alternate(sequences)]
    middle = (len(samples.observations) + 1) // 2
    ends = [slice(None, middle), slice(middle, None)]
    parts = [TeamSamples(*(field[rows] for field in samples)) for rows in ends]
    return [(part, None) for part in parts if len(part.observations)]


def _take(samples: TeamSamples, rows: th.Tensor) -> TeamSamples:
    """Some team steps; ``index_select`` takes half as long as indexing with brackets."""
    return TeamSamples(*(field.index_select(0, rows) for field in samples))
