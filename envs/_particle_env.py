"""The particle tasks as PettingZoo environments: mpe2's worlds with costs, roles and a state."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_e2c.envs._checks import check_render_mode, require_render_mode
from sb3_e2c.envs._particle_config import ParticleConfig, ParticleTask, Start, place
from sb3_e2c.envs._particle_mpe2 import new_world, picture, restart
from sb3_e2c.envs._particle_sim import (
    ParticleSimulator,
    action_spaces,
    observation_spaces,
)


class ParticleEnv(ParallelEnv[str, np.ndarray, Any]):
    """One world of a particle task, stepped and drawn by mpe2, which is imported at first use.

    :param max_cycles: steps of an episode
    :param continuous_actions: five numbers in [0, 1] instead of five actions
    :param cost_with: whose contact costs a team agent; None takes the task's default
    :param render_mode: ``"rgb_array"`` or None
    """

    task: ClassVar[ParticleTask]

    def __init__(
        self,
        max_cycles: int = 80,
        continuous_actions: bool = False,
        cost_with: Iterable[str] | None = None,
        render_mode: str | None = None,
    ) -> None:
        check_render_mode(render_mode)
        self.config = ParticleConfig(self.task, max_cycles, continuous_actions, cost_with)
        self.render_mode = render_mode
        self.possible_agents = self.task.agents
        self.agents: list[str] = []
        self._observation_spaces = observation_spaces(self.config)
        self._action_spaces = action_spaces(self.config)
        self._world: Any = None

    def batched_groups(self, n_worlds: int) -> ParticleSimulator:
        """Build a simulator of many worlds with the same parameters, without mpe2.

        It is not called ``batched`` because its agents come in two groups with observations of
        different sizes.
        """
        return ParticleSimulator(self.config, n_worlds, self.render_mode)

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent, shape (D,)."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Action space of an agent."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start a new episode; see the class for ``options``."""
        if self._world is None:
            self._world = new_world(self.config, self.render_mode)
        self._world.reset(seed=seed)
        if options:
            start = self._start()
            place(self.task, start, options)
            restart(self._world, int(start.goals[0]), start.positions[0])
        self.agents = self.possible_agents[:]
        return self._observations(), {agent: {} for agent in self.agents}

    def _start(self) -> Start:
        """What the last reset drew."""
        world = self._world.world
        goal = world.landmarks.index(world.agents[0].goal_a) if self.task.has_goal else 0
        return Start(np.array([goal]), np.array([[e.state.p_pos for e in world.entities]]))

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, np.ndarray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Move all agents at once."""
        if not self.agents:
            raise ValueError("step() was called although no episode is running; reset first")
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action for {missing}; expected one for each of {self.agents}")
        checked = [self._action(agent, actions[agent]) for agent in self.agents]
        for action in checked:
            self._world.step(action)
        truncated = bool(self._world.truncations[self.agents[0]])
        if truncated:
            self.agents = []
        agents = self.possible_agents
        return (
            self._observations(),
            {agent: float(self._world.rewards[agent]) for agent in agents},
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, truncated),
            {agent: {"cost": cost} for agent, cost in self._costs().items()},
        )

    def _action(self, agent: str, action: Any) -> Any:
        """One agent's action for mpe2; numbers are clipped in double precision."""
        array = np.asarray(action)
        if self.config.continuous_actions:
            if array.shape != (5,) or not np.isfinite(array).all():
                raise ValueError(f"the action of {agent} is {action!r}; expected 5 finite numbers")
            return np.clip(array.astype(np.float64), 0.0, 1.0)
        if array.shape != () or array.dtype.kind not in "iu" or not 0 <= array <= 4:
            raise ValueError(f"the action of {agent} is {action!r}; expected one of 0, ..., 4")
        return int(array)

    def _observations(self) -> dict[str, np.ndarray]:
        return {agent: self._world.observe(agent) for agent in self.possible_agents}

    def _costs(self) -> dict[str, float]:
        """1.0 for who is closer to a counted entity than the sum of their sizes."""
        entities = self._world.world.entities
        costs = dict.fromkeys(self.possible_agents, 0.0)
        for i, j in np.argwhere(self.config.counted):
            agent, other = entities[i], entities[j]
            distance = np.sqrt(np.sum(np.square(agent.state.p_pos - other.state.p_pos)))
            if distance < agent.size + other.size:
                costs[agent.name] = 1.0
        return costs

    def render(self) -> np.ndarray:
        """Picture of the world as mpe2 draws it, uint8, shape (height, width, 3)."""
        require_render_mode(self.render_mode)
        if self._world is None:
            raise ValueError("render() was called before the first episode; reset first")
        return picture(self._world, self.task)

    def close(self) -> None:
        """Forget mpe2's world; mpe2's way to close it would end the pygame of all others, too."""
        self._world, self.agents = None, []

    def __getstate__(self) -> dict[str, Any]:
        """The whole state without pygame's surfaces, which do not pickle."""
        state = self.__dict__.copy()
        if self._world is not None:
            names = ("world", "np_random", "steps", "original_cam_range")
            state["_world"] = {name: getattr(self._world, name) for name in names}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild mpe2's world around its saved state."""
        self.__dict__.update(state)
        if self._world is not None:
            saved, self._world = self._world, new_world(self.config, self.render_mode)
            self._world.reset()
            self._world.__dict__.update(saved)
