"""A team that acts in its worlds, and what comes of it (Alg. 2 l. 3-8, 12).

``MAPPO.collect_rollouts`` steps the worlds of a team; for a model of opponents somebody else does
(``LearningOpponents``). Both act and store through a collector.

Shapes: W worlds, N agents, S = W·N slots, D observation size.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_e2c.buffers import TeamRolloutBuffer
from sb3_e2c.policies import TeamPolicy
from sb3_e2c.recorder import Infos, TeamRecorder
from sb3_e2c.sequences import Memory


class Collector:
    """Lets a policy act in running episodes and fills its rollout buffer.

    :param policy: Of the team
    :param buffer: Where to
    :param recorder: Follows the episodes, which begin here
    :param observations: After a reset of all worlds, shape (S, D)
    :param reset_infos: One dict for each slot
    """

    def __init__(
        self,
        policy: TeamPolicy,
        buffer: TeamRolloutBuffer,
        recorder: TeamRecorder,
        observations: np.ndarray,
        reset_infos: Infos,
    ):
        self.policy, self.buffer, self.recorder = policy, buffer, recorder
        recorder.start(observations, reset_infos)
        self.observations = observations  # the last ones
        self.episode_starts = np.ones(len(observations), bool)  # whether they begin an episode
        self.memory = policy.empty_memory(recorder.n_worlds)

    @property
    def finished_costs(self) -> list[np.ndarray]:
        """Costs of the episodes that ended in this rollout, shape (K, M) each."""
        return self.recorder.finished_costs

    @property
    def device(self) -> th.device:
        """Where the networks are."""
        return self.policy.device

    def begin_rollout(self) -> None:
        """Forget the last rollout; running episodes go on."""
        self.policy.set_training_mode(False)
        running = th.as_tensor(~self.episode_starts[:: self.recorder.n_agents], device=self.device)
        self.memory = Memory(*(states * running[:, None, None] for states in self.memory))
        self.buffer.reset(self.memory if self.policy.recurrent else None)
        self.finished_costs.clear()

    def act(self) -> tuple[np.ndarray, np.ndarray]:
        """Sample actions of all slots on the last observations.

        :return: The actions, and what the environment accepts of them, shapes (S, ...)
        :raises ValueError: If the networks give no finite actions
        """
        states = self.memory.actor.flatten(0, 1)
        with th.no_grad():
            obs, _ = self.policy.obs_to_tensor(self.observations)
            if self.policy.recurrent:
                states = states * th.as_tensor(~self.episode_starts).to(states)[:, None]
            sampled, states = self.policy.act(obs, states)  # type: ignore[arg-type]
        self.memory = self.memory._replace(actor=states.view_as(self.memory.actor))
        space = self.policy.action_space
        actions = sampled.cpu().numpy().reshape(len(self.observations), *space.shape)  # type: ignore[misc]
        if not np.isfinite(actions).all():
            raise ValueError("an action is not finite")
        clipped = isinstance(space, spaces.Box)
        return actions, np.clip(actions, space.low, space.high) if clipped else actions  # type: ignore[attr-defined]

    def check(
        self, new_obs: np.ndarray, rewards: np.ndarray, infos: Sequence[dict[str, Any]]
    ) -> None:
        """Stop if an environment returned numbers that are not finite.

        :param new_obs: Shape (S, D)
        :param rewards: Shape (S,)
        :param infos: One dict for each slot
        """
        self.recorder.check(self.buffer.pos, new_obs, rewards, infos)

    def record(
        self,
        actions: np.ndarray,
        rewards: np.ndarray,
        new_obs: np.ndarray,
        dones: np.ndarray,
        infos: Infos,
        reset_infos: Infos,
    ) -> None:
        """Store what came of the last actions.

        :param actions: As :meth:`act` gave them, shape (S, ...)
        :param rewards: Shape (S,)
        :param new_obs: Shape (S, D)
        :param dones: Whether the step ended an episode, shape (S,)
        :param infos: One dict for each slot
        :param reset_infos: One dict for each slot, new where an episode ended
        """
        self.recorder.record(
            self.buffer,
            last_obs=self.observations,
            episode_starts=self.episode_starts,
            actions=actions,
            rewards=rewards,
            dones=dones,
            infos=infos,
            reset_infos=reset_infos,
        )
        self.follow(new_obs, dones)

    def follow(self, new_obs: np.ndarray, dones: np.ndarray) -> None:
        """Go on from a step, without storing it.

        :param new_obs: Shape (S, D)
        :param dones: Whether the step ended an episode, shape (S,)
        """
        self.observations, self.episode_starts = new_obs, dones

    def finish_rollout(self) -> None:
        """Evaluate all networks on the rollout and compute the advantages."""
        critics = self.buffer.finish(self.policy, self.observations, self.recorder.critic_states)
        self.memory = Memory(self.memory.actor, *critics)
