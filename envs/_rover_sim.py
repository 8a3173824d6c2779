"""The batched simulator of the multi-rover domain: ``W`` worlds in one set of arrays."""

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
from sb3_e2c.envs._rover_config import SENSOR_FLOOR, RoverConfig, place_pois, place_rovers
from sb3_e2c.envs._rover_kernels import (
    SENSOR_TYPES,
    Outcome,
    Rules,
    State,
    observe_worlds,
    step_worlds,
)

Infos = dict[str, np.ndarray]

METADATA: dict[str, Any] = {
    "name": "multi_rover_v0",
    "render_modes": ["rgb_array"],
    "render_fps": 10,
    "is_parallelizable": True,
    "team_return": "shared",
    "team_cost": "sum",
}


class RoverSimulator:
    """All worlds step together; each has its own random stream for the starts of its episodes.

    A world seeded with ``s`` behaves alike whatever ``n_worlds`` is. Worlds are never reset by
    :meth:`step`. The object pickles with its whole state, so a copy continues identically.

    :param config: parameters of the domain
    :param n_worlds: number of worlds, W
    :param render_mode: ``"rgb_array"`` or None
    """

    metadata = METADATA

    def __init__(self, config: RoverConfig, n_worlds: int, render_mode: str | None = None) -> None:
        if n_worlds < 1:
            raise ValueError(f"n_worlds is {n_worlds}; expected at least 1")
        check_render_mode(render_mode)
        self.config = config
        self.n_worlds = n_worlds
        self.render_mode = render_mode
        self.possible_agents = [f"rover_{i}" for i in range(config.n_rovers)]
        self._values = np.array(config.poi_values)
        self._rules = tuple(_rules(config))
        self._observation_spaces = [_observation_space(config) for _ in self.possible_agents]
        self._action_spaces = [spaces.Box(-1.0, 1.0, (2,)) for _ in self.possible_agents]
        self._rngs: list[np.random.Generator | None] = [None] * n_worlds
        self._needs_reset = np.ones(n_worlds, dtype=bool)
        self.state = _initial_state(n_worlds, config.n_rovers, len(self._values))

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent, shape (D,); the same object at every call."""
        return self._observation_spaces[self.possible_agents.index(agent)]

    def action_space(self, agent: str) -> spaces.Box:
        """Action space of an agent, shape (2,); the same object at every call."""
        return self._action_spaces[self.possible_agents.index(agent)]

    def reset(
        self,
        worlds: np.ndarray,
        seeds: Sequence[int | None],
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, Infos]:
        """Start a new episode in some worlds.

        :param worlds: indices of the worlds, shape (R,)
        :param seeds: for each of them a seed that restarts its stream, or None to continue it
        :param options: ``"rovers"`` (N, 2) or (R, N, 2) and ``"pois"`` (K, 2) or (R, K, 2) place
            them by hand; other keys are ignored
        :return: observations (R, N, D) and infos, arrays (R, N, ...)
        """
        worlds = np.asarray(worlds, dtype=np.int64)
        for world, seed in zip(worlds.tolist(), seeds, strict=True):
            rng = self._rngs[world]
            if seed is not None or rng is None:
                rng = self._rngs[world] = np.random.default_rng(seed)
            self.state.positions[world] = place_rovers(self.config, rng)
            self.state.pois[world] = place_pois(self.config, rng)
        for key, target in (("rovers", self.state.positions), ("pois", self.state.pois)):
            if options and options.get(key) is not None:
                target[worlds] = self._placed(key, options[key], (len(worlds), *target.shape[1:]))
        for array in (*self.state[3:], self.state.displacements):
            array[worlds] = 0
        self._needs_reset[worlds] = False
        return self._observe(worlds)

    def _placed(self, key: str, positions: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Hand-placed positions, checked and repeated for all worlds if given once."""
        array = np.asarray(positions, dtype=np.float64)
        if array.shape not in (shape, shape[1:]):
            raise ValueError(
                f"options[{key!r}] has shape {array.shape}; expected {shape[1:]}, or {shape} to "
                "place every world differently"
            )
        if not ((array >= 0.0) & (array <= self.config.dim)).all():
            raise ValueError(
                f"options[{key!r}] has positions outside the world [0, {self.config.dim}]²; "
                f"found {array.tolist()}"
            )
        return np.broadcast_to(array, shape)

    def _observe(self, worlds: np.ndarray) -> tuple[np.ndarray, Infos]:
        n_rovers, n_sensors = self.config.n_rovers, 2 * self.config.n_sectors
        sensors = np.empty((len(worlds), n_rovers, n_sensors), np.float32)
        observations = np.empty((len(worlds), n_rovers, self._observation_size), np.float32)
        state = tuple(self.state)
        observe_worlds(self._rules, self._values, state, worlds, sensors, observations)
        infos = self._infos(worlds, sensors, np.zeros((len(worlds), n_rovers), np.int64))
        return observations, infos

    def _infos(
        self, worlds: np.ndarray | slice, sensors: np.ndarray, captured: np.ndarray
    ) -> Infos:
        """The infos that resets and steps have in common."""
        infos = {
            "captured": captured,
            "position": self.state.positions[worlds].copy(),
            "novelty_observation": sensors,
        }
        if self.config.add_critic_state:
            progress = self.state.clock[worlds] / self.config.max_cycles
            world_state = np.stack([self.state.share[worlds], progress], axis=-1, dtype=np.float32)
            infos["critic_state"] = np.repeat(world_state[:, None], self.config.n_rovers, axis=1)
        return infos

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Advance all worlds by one step, without any reset.

        :param actions: shape (W, N, 2), clipped to [-1, 1]
        :return: observations (W, N, D), rewards (W, N), terminated (W,), truncated (W,) and infos,
            arrays (W, N, ...); all of them fresh
        """
        actions = np.ascontiguousarray(actions, dtype=np.float64)
        self._check_step(actions)
        out = self._empty_outcome()
        step_worlds(self._rules, self._values, tuple(self.state), actions, tuple(out))
        self._needs_reset[:] = out.ended.any(axis=0)
        infos = self._infos(slice(None), out.sensors, out.counts[0])
        infos |= {"cost": out.costs, "beta": out.betas, "colliding_pairs": out.counts[1]}
        return out.observations, out.rewards, out.ended[0], out.ended[1], infos

    def _check_step(self, actions: np.ndarray) -> None:
        shape = (self.n_worlds, self.config.n_rovers, 2)
        check_actions(actions, shape, self.possible_agents)
        check_running(self._needs_reset)

    def _empty_outcome(self) -> Outcome:
        shape = (self.n_worlds, self.config.n_rovers)
        return Outcome(
            observations=np.empty((*shape, self._observation_size), np.float32),
            sensors=np.empty((*shape, 2 * self.config.n_sectors), np.float32),
            rewards=np.empty(shape, np.float32),
            costs=np.empty(shape, np.float32),
            betas=np.empty(shape, np.float32),
            counts=np.empty((2, *shape), np.int64),
            ended=np.empty((2, self.n_worlds), np.bool_),
        )

    @property
    def _observation_size(self) -> int:
        return self._observation_spaces[0].shape[0]

    def render(self, world: int = 0) -> np.ndarray:
        """Picture of one world.

        :param world: index of the world
        :return: RGB image, uint8, shape (height, width, 3)
        """
        require_render_mode(self.render_mode)
        from sb3_e2c.envs._rover_render import draw_world  # Pillow is needed for pictures only

        return draw_world(self.config, State(*(array[world] for array in self.state)))

    def close(self) -> None:
        """Nothing to release."""


def _rules(config: RoverConfig) -> Rules:
    same_name = {name: getattr(config, name) for name in Rules._fields if hasattr(config, name)}
    same_name["sensor_type"] = SENSOR_TYPES.index(config.sensor_type)
    return Rules(
        **same_name,
        log_scale=config.sensor_scale == "log",
        pay_at_capture=config.reward_at == "capture",
        limit_terminates=config.time_limit == "terminate",
    )


def _initial_state(n_worlds: int, n_rovers: int, n_pois: int) -> State:
    return State(
        positions=np.zeros((n_worlds, n_rovers, 2)),
        displacements=np.zeros((n_worlds, n_rovers, 2)),
        pois=np.zeros((n_worlds, n_pois, 2)),
        captured=np.zeros((n_worlds, n_pois), dtype=bool),
        share=np.zeros(n_worlds),
        clock=np.zeros(n_worlds, dtype=np.int64),
        team_cost=np.zeros(n_worlds),
        colliding=np.zeros((n_worlds, n_rovers), dtype=bool),
    )


def _observation_space(config: RoverConfig) -> spaces.Box:
    """Sensors, then the optional identity, displacement and position."""
    nearest = 1.0 / SENSOR_FLOOR**2
    values = config.poi_values
    others = max(config.n_rovers - 1, 1)
    summed = config.sensor_type == "sum"
    rover_high = nearest * (others if summed else 1)
    poi_high = nearest * (sum(values) if summed else max(values))
    if config.sensor_scale == "log":
        rover_high = poi_high = 1.0
    low = [-1.0] * (2 * config.n_sectors)
    high = [rover_high] * config.n_sectors + [poi_high] * config.n_sectors
    if config.add_id:
        low, high = low + [0.0] * config.n_rovers, high + [1.0] * config.n_rovers
    if config.add_velocity:
        low, high = low + [-config.max_step] * 2, high + [config.max_step] * 2
    if config.add_position:
        low, high = low + [0.0] * 2, high + [1.0] * 2
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
