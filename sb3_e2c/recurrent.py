"""Networks with a memory: a GRU in the actor and in all critics ("GruPolicy" of MAPPO, Sec. 5.2).

Each network is its MLP, then a GRU, then its output layer. Whole sequences are trained, without
padding (see ``sequences.py``, ``gru.py``).
"""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from torch import nn

from sb3_e2c.gru import run_sequences, run_step
from sb3_e2c.policies import TeamPolicy
from sb3_e2c.sequences import Memory, Sequences


class GruPolicy(TeamPolicy):
    """Shared recurrent actor, recurrent reward critic and cost critics.

    Hidden states belong to slots (actor, individual cost critics) and to worlds (joint critics),
    and are zero at the start of an episode.

    :param args: See :class:`TeamPolicy`
    :param gru_hidden_size: Hidden units H of each GRU
    :param kwargs: See :class:`TeamPolicy`
    """

    recurrent = True

    def __init__(self, *args: Any, gru_hidden_size: int = 128, **kwargs: Any):
        self.gru_hidden_size = gru_hidden_size
        super().__init__(*args, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "gru_hidden_size": self.gru_hidden_size}

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        extractor = self.mlp_extractor
        self.actor_gru = self._make_gru(extractor.latent_dim_pi)
        self.value_gru = self._make_gru(extractor.latent_dim_vf)
        # the output layers, which the base class makes, read the GRUs
        extractor.latent_dim_pi = extractor.latent_dim_vf = self.gru_hidden_size

    def _build_cost_critic(self) -> None:
        super()._build_cost_critic()
        if self.n_constraints:
            assert isinstance(self.cost_net, nn.Linear)
            self.cost_gru = self._make_gru(self.cost_net.in_features)
            self.cost_net = nn.Linear(self.gru_hidden_size, self.n_constraints)
            self._init_orthogonal(self.cost_net, gain=1.0)

    def _make_gru(self, input_dim: int) -> nn.GRU:
        gru = nn.GRU(input_dim, self.gru_hidden_size)
        if self.ortho_init:
            for name, parameter in gru.named_parameters():
                init = nn.init.orthogonal_ if "weight" in name else nn.init.zeros_
                init(parameter)
        return gru

    def _critic_modules(self) -> list[nn.Module]:
        return [*super()._critic_modules(), self.value_gru]

    def _cost_modules(self) -> list[nn.Module]:
        return [*super()._cost_modules(), *([self.cost_gru] if self.n_constraints else [])]

    def _actor_latent(self, features: th.Tensor, sequences: Sequences | None) -> th.Tensor:
        hidden = super()._actor_latent(features, sequences)
        if sequences is None:
            return _run(self.actor_gru, hidden, None, None)
        return _run(
            self.actor_gru, hidden, sequences.batch_sizes * self.n_agents, sequences.initial.actor
        )

    def _value_latent(self, features: th.Tensor, sequences: Sequences | None) -> th.Tensor:
        hidden = super()._value_latent(features, sequences)
        if sequences is None:
            return _run(self.value_gru, hidden, None, None)
        return _run(self.value_gru, hidden, sequences.batch_sizes, sequences.initial.value)

    def _cost_latent(self, features: th.Tensor, sequences: Sequences | None) -> th.Tensor:
        hidden = super()._cost_latent(features, sequences)
        if sequences is None:
            return _run(self.cost_gru, hidden, None, None)
        batch_sizes = sequences.batch_sizes * self.n_parties
        return _run(self.cost_gru, hidden, batch_sizes, sequences.initial.cost)

    def empty_memory(self, n_worlds: int) -> Memory:
        """Hidden states at the start of an episode, all zero.

        :param n_worlds: W
        """
        size = self.gru_hidden_size if self.n_constraints else 0
        owners = ((self.n_agents, self.gru_hidden_size), (1, self.gru_hidden_size))
        shapes = (*owners, (self.n_parties, size))
        return Memory(*(th.zeros(n_worlds, *shape, device=self.device) for shape in shapes))

    def act(self, obs: th.Tensor, states: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Sample actions; see :meth:`TeamPolicy.act`."""
        states = self._step(obs, states)
        return self._sample(states), states

    def _step(self, obs: th.Tensor, states: th.Tensor) -> th.Tensor:
        """Next hidden states of the actor, its last layer before the actions, shape (S, H)."""
        features = super(TeamPolicy, self).extract_features(obs)
        features = features[0] if isinstance(features, tuple) else features
        hidden = self.mlp_extractor.forward_actor(features)
        return run_step(self.actor_gru, hidden, states)

    def get_distribution(self, obs: Any) -> Distribution:
        """Action distribution at the start of an episode, where hidden states are zero."""
        states = self._step(obs, self._no_states(len(obs)))
        return self._get_action_dist_from_latent(states)

    def _no_states(self, n_slots: int) -> th.Tensor:
        return th.zeros(n_slots, self.gru_hidden_size, device=self.device)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions of any number of agents from their own observations and hidden states.

        :param observation: Shape (D,) or (n, D)
        :param state: ``(h,)`` with h of shape (1, n, H), as returned by the last call; None at the
            start of an episode
        :param episode_start: Where to begin with a zero state, shape (n,), or one bool for all
        :param deterministic: Whether to take the most likely action
        :return: Actions, shape (...) or (n, ...), and the next ``(h,)``
        """
        self.set_training_mode(False)
        obs, vectorized = self.obs_to_tensor(observation)
        assert isinstance(obs, th.Tensor)
        states = self._no_states(len(obs))
        if state is not None:
            states = th.as_tensor(state[0][0], device=self.device)
            if episode_start is not None:
                starts = np.asarray(episode_start, dtype=bool)
                if starts.shape not in ((), (len(obs),)):
                    raise ValueError(
                        f"episode_start has the shape {starts.shape}; expected ({len(obs)},), one "
                        "for each observation"
                    )
                running = np.broadcast_to(~starts, len(obs)).copy()
                states = states * th.as_tensor(running, device=self.device)[:, None]
        with th.no_grad():
            states = self._step(obs, states)
            distribution = self._get_action_dist_from_latent(states)
            actions = distribution.get_actions(deterministic=deterministic).cpu().numpy()
        actions = self._clip(actions.reshape(-1, *self.action_space.shape))  # type: ignore[misc]
        return (actions if vectorized else actions.squeeze(axis=0)), (states[None].cpu().numpy(),)

    def _clip(self, actions: np.ndarray) -> np.ndarray:
        low, high = (
            getattr(self.action_space, "low", None),
            getattr(self.action_space, "high", None),
        )
        return actions if low is None else np.clip(actions, low, high)


def _run(
    gru: nn.GRU, inputs: th.Tensor, batch_sizes: th.Tensor | None, initial: th.Tensor | None
) -> th.Tensor:
    """Hidden states after every step of sequences.

    :param gru: The layer
    :param inputs: Steps in the order of ``PackedSequence``, shape (B, F)
    :param batch_sizes: Shape (L,); None: one step of each sequence
    :param initial: Hidden states before the first steps, shape (k, owners, H); None: zero
    :return: Shape (B, H)
    """
    if batch_sizes is None or initial is None:
        return run_step(gru, inputs, inputs.new_zeros(len(inputs), gru.hidden_size))
    return run_sequences(gru, inputs, batch_sizes, initial.flatten(0, 1))
