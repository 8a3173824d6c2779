"""The batched simulator of the robot tasks: ``W`` worlds, MuJoCo on threads, the rest in arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_e2c.envs._checks import (
    check_actions,
    check_render_mode,
    check_running,
    require_render_mode,
)
from sb3_e2c.envs._mujoco_config import METADATA, RobotConfig
from sb3_e2c.envs._mujoco_models import build_fast_model, build_model
from sb3_e2c.envs._mujoco_physics import new_physics
from sb3_e2c.envs._mujoco_render import Painter
from sb3_e2c.envs._mujoco_robots import clipped, new_robot
from sb3_e2c.envs._mujoco_start import draw_start, place
from sb3_e2c.envs._mujoco_views import View

Infos = dict[str, np.ndarray]

# What a pickle holds besides MuJoCo's state
_STATE = (
    *("config", "n_worlds", "render_mode", "possible_agents", "now"),
    *("_rngs", "_needs_reset", "_clock", "_is_costing"),
)


class RobotSimulator:
    """All worlds step together; each has its own random stream for the starts of its episodes.

    A world seeded with ``s`` behaves like the environment reset with seed ``s``, whatever
    ``n_worlds`` and the number of threads are. Worlds are never reset by :meth:`step`. The object
    pickles with its whole state, so a copy continues identically.

    :param config: parameters of the task
    :param n_worlds: number of worlds, W
    :param render_mode: ``"rgb_array"`` or None
    """

    metadata = METADATA

    def __init__(self, config: RobotConfig, n_worlds: int, render_mode: str | None = None) -> None:
        if n_worlds < 1:
            raise ValueError(f"n_worlds is {n_worlds}; expected at least 1")
        check_render_mode(render_mode)
        self.config = config
        self.n_worlds = n_worlds
        self.render_mode = render_mode
        self.possible_agents = config.agents
        self._rngs: list[np.random.Generator | None] = [None] * n_worlds
        self._needs_reset = np.ones(n_worlds, dtype=bool)
        self._clock = np.zeros(n_worlds, dtype=np.int64)
        self._is_costing = np.zeros(n_worlds, dtype=bool)
        self._build()
        self.now = self._physics.read()

    def _build(self) -> None:
        """Make what follows from the parameters alone."""
        self.robot = new_robot(self.config)
        self.model = build_fast_model(self.config)
        n_threads = self.config.n_threads
        self._physics = new_physics(self.model, self.n_worlds, self.robot.needs_contact, n_threads)
        self._view = View(self.config, self.robot, self._physics.read())
        self._order = self.config.action_order
        n_actions = len(self._order) // len(self.possible_agents)
        self._observation_spaces = {agent: self._view.space() for agent in self.possible_agents}
        self._action_spaces = {
            agent: spaces.Box(-1.0, 1.0, (n_actions,)) for agent in self.possible_agents
        }
        self._painter: Painter | None = None

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent, shape (D,); the same object at every call."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Action space of an agent, shape (A,); the same object at every call."""
        return self._action_spaces[agent]

    def reset(
        self,
        worlds: np.ndarray,
        seeds: Sequence[int | None],
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, Infos]:
        """Start a new episode in some worlds.

        :param worlds: indices of the worlds, shape (R,)
        :param seeds: for each of them a seed that restarts its stream, or None to continue it
        :param options: ``"qpos"`` (nq,) or (R, nq) and ``"qvel"`` (nv,) or (R, nv) place the
            robots by hand; other keys are ignored
        :return: observations (R, N, D) and infos, arrays (R, N)
        """
        worlds = np.asarray(worlds, dtype=np.int64)
        starts = [
            draw_start(self.robot, self.model, self._rng(world, seed))
            for world, seed in zip(worlds.tolist(), seeds, strict=True)
        ]
        starts = place(starts, options)
        begun = self._physics.restart(worlds, starts)
        for array, rows in zip(self.now, begun, strict=True):
            array[worlds] = rows
        self._clock[worlds] = 0
        self._is_costing[worlds] = self._needs_reset[worlds] = False
        return self._view.observe(begun), self._for_agents(self.robot.whereabouts(begun))

    def _rng(self, world: int, seed: int | None) -> np.random.Generator:
        rng = self._rngs[world]
        if seed is not None or rng is None:
            rng = self._rngs[world] = np.random.default_rng(seed)
        return rng

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Advance all worlds by one step, without any reset.

        :param actions: shape (W, N, A), clipped to [-1, 1]
        :return: observations (W, N, D), rewards (W, N), terminated (W,), truncated (W,) and infos,
            arrays (W, N); all of them fresh
        """
        actions = np.asarray(actions, dtype=np.float64)
        self._check_step(actions)
        joined = clipped(actions, 1.0).reshape(self.n_worlds, -1)
        motors = joined.take(self._order, axis=1)
        before = self.now
        self.now = self._physics.advance(self.robot.controls(motors, before.time))
        verdict = self.robot.judge(before, self.now, motors)
        self._clock += 1
        truncated = self._clock >= self.config.max_steps
        self._is_costing = verdict.costs > 0.0
        self._needs_reset = verdict.terminated | truncated
        infos = self._for_agents(verdict.infos | {"reward": verdict.rewards})
        rewards = infos.pop("reward").astype(np.float32)
        return self._view.observe(self.now), rewards, verdict.terminated, truncated, infos

    def _check_step(self, actions: np.ndarray) -> None:
        n_agents = len(self.possible_agents)
        shape = (self.n_worlds, n_agents, len(self._order) // n_agents)
        check_actions(actions, shape, self.possible_agents)
        check_running(self._needs_reset)

    def _for_agents(self, values: dict[str, np.ndarray]) -> Infos:
        """The numbers of worlds (W,), the same for each of their agents (W, N)."""
        rows = np.array(list(values.values()))[:, :, None]
        return dict(zip(values, np.repeat(rows, len(self.possible_agents), axis=2), strict=True))

    def render(self, world: int = 0) -> np.ndarray:
        """Picture of one world.

        :param world: index of the world
        :return: RGB image, uint8, shape (480, 640, 3)
        """
        require_render_mode(self.render_mode)
        if self._painter is None:
            self._painter = Painter(build_model(self.config))
        return self._painter.draw(self.now.qpos[world], bool(self._is_costing[world]))

    def close(self) -> None:
        """Release the OpenGL context, if there is one, and the threads."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None
        self._physics.close()

    def __getstate__(self) -> dict[str, Any]:
        """The whole state: numbers and random streams, not what :meth:`_build` makes again."""
        state = {name: getattr(self, name) for name in _STATE}
        return state | {"mujoco": self._physics.get_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickle was taken."""
        physics = state.pop("mujoco")
        self.__dict__.update(state)
        self._build()
        self._physics.set_state(physics)
