"""The batched simulator of the particle tasks: ``W`` worlds in one set of arrays, two groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_e2c.envs._checks import check_render_mode, check_running, require_render_mode
from sb3_e2c.envs._particle_config import TASKS, ParticleConfig, draw_starts, place
from sb3_e2c.envs._particle_kernels import (
    Outcome,
    Rules,
    State,
    observe_worlds,
    push_by_actions,
    step_worlds,
)
from sb3_e2c.envs._particle_views import colors, constant_numbers, terms

Grouped = dict[str, np.ndarray]
Infos = dict[str, dict[str, np.ndarray]]

_GROUPS = ("team", "opponents")


class ParticleSimulator:
    """All worlds step together; each has its own random stream for the starts of its episodes.

    Agents come in two groups, "team" and "opponents", whose observations differ in size. What
    belongs to agents is a dict of arrays by group, shape (W, n, ...), with the agents in the order
    of ``groups``. A world seeded with ``s`` behaves like the environment reset with seed ``s``.
    Worlds are never reset by :meth:`step`. The object pickles with its whole state.

    :param config: task and parameters
    :param n_worlds: number of worlds, W
    :param render_mode: ``"rgb_array"`` or None
    """

    def __init__(
        self, config: ParticleConfig, n_worlds: int, render_mode: str | None = None
    ) -> None:
        if n_worlds < 1:
            raise ValueError(f"n_worlds is {n_worlds}; expected at least 1")
        check_render_mode(render_mode)
        task = config.task
        self.config = config
        self.n_worlds = n_worlds
        self.render_mode = render_mode
        self.metadata = task.metadata
        self.possible_agents = task.agents
        self.groups = task.groups
        self.observation_sizes = task.observation_sizes
        self._members = task.members
        self._observation_spaces = observation_spaces(config)
        self._action_spaces = action_spaces(config)
        self._rules = tuple(_rules(config))
        bodies = task.bodies[: len(task.agents)]
        self._accelerations = np.array([body.acceleration for body in bodies])
        self._rngs: list[np.random.Generator | None] = [None] * n_worlds
        self._needs_reset = np.ones(n_worlds, dtype=bool)
        self.state = _initial_state(n_worlds, len(task.agents), len(task.bodies))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the tables of the compiled code anew: an older version may have pickled others."""
        self.__dict__.update(state)
        self._rules = tuple(_rules(self.config))

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent; the same object at every call."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Action space of an agent; the same object at every call."""
        return self._action_spaces[agent]

    def reset(
        self,
        worlds: np.ndarray,
        seeds: Sequence[int | None],
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Grouped, Infos]:
        """Start a new episode in some worlds.

        :param worlds: indices of the worlds, shape (R,)
        :param seeds: for each of them a seed that restarts its stream, or None to continue it
        :param options: "agents" (4, 2) or (R, 4, 2), "landmarks" (K, 2) or (R, K, 2) and "goal",
            one number or (R,), place by hand what they name; other keys are ignored
        :return: observations (R, n, D) and infos (empty), both by group
        """
        worlds = np.asarray(worlds, dtype=np.int64)
        pairs = zip(worlds.tolist(), seeds, strict=True)
        start = draw_starts(self.config.task, [self._stream(w, seed) for w, seed in pairs])
        place(self.config.task, start, options)
        self.state.goals[worlds] = start.goals
        self.state.positions[worlds] = self.state.starts[worlds] = start.positions
        self.state.velocities[worlds] = 0.0
        self.state.clock[worlds] = 0
        self._needs_reset[worlds] = False
        return self._observe(worlds), {group: {} for group in _GROUPS}

    def _stream(self, world: int, seed: int | None) -> np.random.Generator:
        rng = self._rngs[world]
        if seed is not None or rng is None:
            rng = self._rngs[world] = np.random.default_rng(seed)
        return rng

    def _observe(self, worlds: np.ndarray) -> Grouped:
        rows = self._empty_rows(len(worlds))
        observe_worlds(self._rules, tuple(self.state), worlds, *rows)
        return self._grouped(rows)

    def _empty_rows(self, n_worlds: int) -> tuple[np.ndarray, np.ndarray]:
        """Room for the observations of the team and of the opponents, (n_worlds, n · D)."""
        team, opponents = (
            np.empty(
                (n_worlds, len(self.groups[group]) * self.observation_sizes[group]), np.float32
            )
            for group in _GROUPS
        )
        return team, opponents

    def _grouped(self, rows: tuple[np.ndarray, np.ndarray]) -> Grouped:
        """The same arrays, each in the shape (n_worlds, n, D)."""
        return {
            group: array.reshape(-1, len(self.groups[group]), self.observation_sizes[group])
            for group, array in zip(_GROUPS, rows, strict=True)
        }

    def step(
        self, actions: Mapping[str, np.ndarray]
    ) -> tuple[Grouped, Grouped, np.ndarray, np.ndarray, Infos]:
        """Advance all worlds by one step, without any reset.

        :param actions: by group, integers (W, n), or numbers (W, n, 5) clipped to [0, 1]
        :return: observations (W, n, D) and rewards (W, n) by group, terminated (W,), truncated
            (W,), and infos by group, "cost" (W, n); all of them fresh
        """
        check_running(self._needs_reset)
        controls = self._controls(actions)
        rows = self._empty_rows(self.n_worlds)
        shape = controls.shape[:2]
        out = Outcome(
            *rows,
            rewards=np.empty(shape, np.float32),
            costs=np.empty(shape, np.float32),
            truncated=np.empty(self.n_worlds, np.bool_),
        )
        step_worlds(self._rules, tuple(self.state), controls, tuple(out))
        self._needs_reset[:] = out.truncated
        rewards = {group: out.rewards[:, members] for group, members in self._members.items()}
        infos = {group: {"cost": out.costs[:, self._members[group]]} for group in _GROUPS}
        terminated = np.zeros(self.n_worlds, np.bool_)
        return self._grouped(rows), rewards, terminated, out.truncated, infos

    def _controls(self, actions: Mapping[str, np.ndarray]) -> np.ndarray:
        """The forces (W, A, 2) that the agents apply, in world order."""
        tail = (5,) if self.config.continuous_actions else ()
        dtype = np.float64 if self.config.continuous_actions else np.int64
        joint = np.empty((self.n_worlds, len(self.possible_agents), *tail), dtype)
        for group, members in self._members.items():
            if group not in actions:
                raise ValueError(f"actions have no {group!r}; expected all of {_GROUPS}")
            given = np.asarray(actions[group])
            if given.shape != (shape := joint[:, members].shape):
                raise ValueError(
                    f"actions of the {group} have shape {given.shape}; expected {shape}"
                )
            if not self.config.continuous_actions and given.dtype.kind not in "iu":
                raise ValueError(
                    f"actions of the {group} are {given.dtype}; expected integers, or use "
                    "continuous_actions=True"
                )
            joint[:, members] = given
        return self._forces(joint)

    def _forces(self, actions: np.ndarray) -> np.ndarray:
        """The forces (W, A, 2) of actions (W, A) or (W, A, 5), checked."""
        controls = np.zeros((*actions.shape[:2], 2))
        if self.config.continuous_actions:
            bad = ~np.isfinite(actions).all(axis=-1)
            first = int(bad.argmax()) if bad.any() else -1
            inside = np.clip(actions, 0.0, 1.0)
            directions = inside[..., 2::2] - inside[..., 1::2]
            np.multiply(directions, self._accelerations[:, None], out=controls)
        else:
            first = push_by_actions(actions, self._accelerations, controls)
        if first >= 0:
            world, agent = divmod(first, len(self.possible_agents))
            expected = (
                "five finite numbers" if self.config.continuous_actions else "one of 0, ..., 4"
            )
            raise ValueError(
                f"the action of {self.possible_agents[agent]} in world {world} is "
                f"{actions[world, agent].tolist()}; expected {expected}"
            )
        return controls

    def render(self, world: int = 0) -> np.ndarray:
        """Picture of one world, drawn by mpe2.

        :param world: index of the world
        :return: RGB image, uint8, shape (height, width, 3)
        """
        require_render_mode(self.render_mode)
        from sb3_e2c.envs._particle_mpe2 import new_world, picture, restart  # only for pictures

        painter = new_world(self.config, self.render_mode)
        restart(painter, int(self.state.goals[world]), self.state.starts[world])
        positions = self.state.positions[world]
        for entity, position in zip(painter.world.entities, positions, strict=True):
            entity.state.p_pos = position.copy()
        return picture(painter, self.config.task)

    def close(self) -> None:
        """Nothing to release."""


def observation_spaces(config: ParticleConfig) -> dict[str, spaces.Box]:
    """Observation space of every agent, shape (D,)."""
    task = config.task
    return {
        agent: spaces.Box(-np.inf, np.inf, (task.observation_sizes[group],), np.float32)
        for group, names in task.groups.items()
        for agent in names
    }


def action_spaces(config: ParticleConfig) -> dict[str, spaces.Space]:
    """Action space of every agent."""
    if config.continuous_actions:
        return {agent: spaces.Box(0.0, 1.0, (5,)) for agent in config.task.agents}
    return {agent: spaces.Discrete(5) for agent in config.task.agents}


def _rules(config: ParticleConfig) -> Rules:
    task, n_agents = config.task, len(config.task.agents)
    sizes, collides, _, max_speeds = (np.array(column) for column in zip(*task.bodies, strict=True))
    team = np.array([agent in task.team for agent in task.agents])
    touching = np.add.outer(sizes, sizes)
    pairs = {
        "pushing": np.triu(np.outer(collides[:n_agents], collides), k=1),
        "counted": config.counted,
        "catching": np.outer(~team, team),
    }
    found = {name: np.argwhere(chosen) for name, chosen in pairs.items()}
    return Rules(
        task=TASKS.index(task),
        max_cycles=config.max_cycles,
        is_team=team,
        max_speeds=max_speeds[:n_agents],
        **found,
        **{f"{name}_at": touching[tuple(rows.T)] for name, rows in found.items()},
        goal_colors=colors(task.n_landmarks, 0.25, 0.5),
        numbers=constant_numbers(task),
        **{group: terms(task, group) for group in _GROUPS},
    )


def _initial_state(n_worlds: int, n_agents: int, n_entities: int) -> State:
    return State(
        positions=np.zeros((n_worlds, n_entities, 2)),
        velocities=np.zeros((n_worlds, n_agents, 2)),
        goals=np.zeros(n_worlds, dtype=np.int64),
        clock=np.zeros(n_worlds, dtype=np.int64),
        starts=np.zeros((n_worlds, n_entities, 2)),
    )
