"""From what worlds answer to what the learner stores: costs, time-outs, the critics' extra state.

Shapes: W worlds, N agents, S = W·N slots, D observation size, G size of the critics' extra state,
K constrained parties (1 or N), M constraints.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_e2c.buffers import TeamRolloutBuffer, Timeout
from sb3_e2c.checks import as_type, check_costs, check_finite
from sb3_e2c.constraints import check_n_costs, n_parties, party_costs, read_costs

Infos = Sequence[dict[str, Any]]


class TeamRecorder:
    """Follows the running episodes of all worlds and writes their steps to a rollout buffer.

    :param agents: Names of the N agents
    :param n_worlds: W
    :param n_constraints: M
    :param cost_scope: "team" or "individual"
    :param team_cost: How the costs of agents make the team's, "sum" or "max"
    :param critic_state_dim: G
    """

    def __init__(
        self,
        agents: Sequence[str],
        n_worlds: int,
        n_constraints: int,
        cost_scope: str,
        team_cost: str,
        critic_state_dim: int,
    ):
        self.agents = list(agents)
        self.n_worlds = n_worlds
        self.n_constraints = n_constraints
        self.cost_scope, self.team_cost = cost_scope, team_cost
        self.critic_state_dim = critic_state_dim
        self.finished_costs: list[np.ndarray] = []  # (K, M) for each episode of this rollout

    @property
    def n_agents(self) -> int:
        """N."""
        return len(self.agents)

    def start(self, observations: np.ndarray, reset_infos: Infos) -> None:
        """Begin anew after a reset of all worlds.

        :param observations: Shape (S, D)
        :param reset_infos: One dict for each slot
        """
        parties = n_parties(self.cost_scope, self.n_agents)
        self.episode_costs = np.zeros((self.n_worlds, parties, self.n_constraints))
        self.critic_states = self._critic_states(reset_infos, "after a reset")
        check_finite(self.agents, "after a reset", observation=observations)

    def check(self, step: int, new_obs: np.ndarray, rewards: np.ndarray, infos: Infos) -> None:
        """Stop before numbers that are not finite reach callbacks, which may replace rewards.

        :param step: Of this rollout, from 0
        :param new_obs: Shape (S, D)
        :param rewards: Of the environment, shape (S,)
        :param infos: One dict for each slot; costs without limits are checked here
        """
        check_finite(self.agents, _at(step), observation=new_obs, reward=rewards)
        if not self.n_constraints:
            check_costs(self.agents, _at(step), read_costs(infos, self.agents), limited=False)

    def record(
        self,
        buffer: TeamRolloutBuffer,
        last_obs: np.ndarray,
        episode_starts: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        dones: np.ndarray,
        infos: Infos,
        reset_infos: Infos,
    ) -> None:
        """Store one step of all slots, which :meth:`check` has seen.

        :param buffer: Where to
        :param last_obs: Observations before the step, shape (S, D)
        :param episode_starts: Whether they began an episode, shape (S,)
        :param actions: Shape (S, A)
        :param rewards: Shape (S,)
        :param dones: Whether the step ended an episode, shape (S,)
        :param infos: One dict for each slot
        :param reset_infos: One dict for each slot, new where an episode ended
        """
        ended = dones[:: self.n_agents]
        when = _at(buffer.pos)
        check_finite(self.agents, when, reward=rewards)  # a callback may have replaced them
        agent_costs = self._agent_costs(infos, when)
        costs = party_costs(agent_costs, self.cost_scope, self.team_cost)
        critic_states = self._critic_states(infos, when)
        timeout = self._timeout(buffer.pos, ended, infos, critic_states)
        step = (last_obs, actions, rewards, episode_starts, costs, self.critic_states)
        buffer.add(*step, ended, timeout)
        self.episode_costs += costs
        if ended.any():
            self.finished_costs.extend(self.episode_costs[ended])
            self.episode_costs[ended] = 0.0
            critic_states[ended] = self._critic_states(reset_infos, when)[ended]
        self.critic_states = critic_states

    def _agent_costs(self, infos: Infos, when: str) -> np.ndarray:
        """Constrained costs of every agent, shape (W, N, M)."""
        if not self.n_constraints:
            return np.zeros((self.n_worlds, self.n_agents, 0))
        costs = read_costs(infos, self.agents)
        check_n_costs(costs, self.n_constraints, self.agents)
        check_costs(self.agents, when, costs, limited=True)
        return costs

    def _critic_states(self, infos: Infos, when: str) -> np.ndarray:
        """Extra state of the critics, shape (W, G)."""
        if not self.critic_state_dim:
            return np.zeros((self.n_worlds, 0), np.float32)
        found = [info.get("critic_state", ()) for info in infos[:: self.n_agents]]
        for world, state in enumerate(found):
            if np.shape(state) != (self.critic_state_dim,):
                raise ValueError(
                    f"info['critic_state'] of world {world} has the shape {np.shape(state)}; "
                    f"expected ({self.critic_state_dim},), at every reset and every step. "
                    f"This was {when}"
                )
        states = as_type(np.array(found), np.float32)
        if states is None:
            raise ValueError(
                f"info['critic_state'] is {found[0]!r} in world 0 {when}; expected numbers"
            )
        check_finite(self.agents[:1], when, critic_state=states)
        return states

    def _timeout(
        self, step: int, ended: np.ndarray, infos: Infos, critic_states: np.ndarray
    ) -> Timeout | None:
        cut_off = [
            world
            for world in np.flatnonzero(ended).tolist()
            if all(info.get("TimeLimit.truncated", False) for info in self._team(infos, world))
        ]
        if not cut_off:
            return None
        worlds = np.array(cut_off)
        last = [[i["terminal_observation"] for i in self._team(infos, w)] for w in cut_off]
        observations = np.concatenate([np.array(team) for team in last])
        check_finite(self.agents, _at(step), worlds, terminal_observation=observations)
        return Timeout(step, worlds, observations, critic_states[worlds])

    def _team(self, infos: Infos, world: int) -> Infos:
        """Infos of the agents of a world."""
        return infos[world * self.n_agents : (world + 1) * self.n_agents]


def _at(step: int) -> str:
    return f"at step {step} of the rollout"
