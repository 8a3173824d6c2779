"""One environment that can be computed by hand, used by all tests that need one."""

import signal
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv

# Tests run side by side; threads that wait for each other would only slow them down.
th.set_num_threads(1)

# Shells start background jobs with Ctrl-C ignored, and so do their children; some tests send it.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

SLOW, FAST = 0, 1
AGENTS = ["agent_0", "agent_1"]


class TwoOnALine(ParallelEnv):
    """Two agents walk along a line for ``length`` steps, each of them slow (0) or fast (1).

    Slow: 1 forward, reward 1, no cost. Fast: 2 forward, reward 1 + ``gains[t]``, cost 1 (times
    ``agent_costs[agent]``). agent_0 starts at ``start``, agent_1 one ahead; ``start`` is 0, or
    drawn from 0, ..., ``spread`` - 1 at every reset. An agent observes its own position, its
    teammate's and the number of steps taken.

    With length 4, agent_0 always fast and agent_1 always slow: the rewards are 2 and 1 at every
    step, the returns 8 and 4 (team: 12), the costs 4 and 0 (team: 4), the last positions 8 and 5.

    For learning: with the default gains, each unit of cost buys 1 reward, so under a team limit l
    the best expected team return is 2 · length + l; all fast earns 4 · length at cost 2 · length.
    With length 4 and gains (4, 3, 2, 1) the best safe policy under the team limit 4 is a pure one,
    both fast in the first two steps only: team return 2 · (4 + 4 + 3) = 22 at cost 4, against
    2 · (4 + 10) = 28 at cost 8 without limit, and 8 at cost 0 for all slow. A multiplier between
    2 and 3 makes it optimal.

    ``reset(options=...)`` knows ``"length"``, kept from then on, and ``"start"``, for one episode.

    :param length: steps of an episode
    :param end: "truncated", "terminated" or "both", how an episode ends
    :param agent_costs: cost of a fast step of each agent
    :param n_costs: M; cost j is (j + 1) times the first, and 0 means that none is reported
    :param shared: whether both get the sum of what they earn
    :param gains: reward of a fast step beyond that of a slow one, for each step
    :param spread: number of possible starts
    :param critic_state: whether the infos have ``critic_state`` = (t / length,)
    :param team_cost: "sum" or "max"
    :param render_mode: "rgb_array" or None; the picture is all in the colour of ``start``
    """

    def __init__(
        self,
        length: int = 4,
        end: str = "truncated",
        agent_costs: tuple[float, float] = (1.0, 1.0),
        n_costs: int = 1,
        shared: bool = False,
        gains: Sequence[float] | None = None,
        spread: int = 1,
        critic_state: bool = False,
        team_cost: str = "sum",
        render_mode: str | None = None,
    ):
        self.parameters = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        self.length, self.end, self.agent_costs = length, end, agent_costs
        self.n_costs, self.shared, self.spread = n_costs, shared, spread
        self.gains = [1.0] * 100 if gains is None else list(gains)
        self.critic_state, self.render_mode = critic_state, render_mode
        self.metadata = {
            "name": "two_on_a_line_v0",
            "render_modes": ["rgb_array"],
            "render_fps": 5,
            "team_return": "shared" if shared else "sum",
            "team_cost": team_cost,
        }
        self.possible_agents = AGENTS[:]
        self.agents: list[str] = []
        self.rng = np.random.default_rng()
        self.closed = False

    def batched(self, n_worlds: int) -> "TwoOnManyLines":
        return TwoOnManyLines(n_worlds, **self.parameters)

    def observation_space(self, agent: str) -> spaces.Box:
        return spaces.Box(0.0, np.inf, (3,))

    def action_space(self, agent: str) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        options = options or {}
        self.length = options.get("length", self.length)
        self.start = options.get("start", int(self.rng.integers(self.spread)))
        self.positions = [float(self.start), self.start + 1.0]
        self.t = 0
        self.agents = self.possible_agents[:]
        return self._observations(), {
            agent: self._info() | {"start": self.start} for agent in AGENTS
        }

    def step(self, actions: dict[str, int]) -> tuple[dict, dict, dict, dict, dict]:
        fast = [int(actions[agent]) for agent in AGENTS]
        self.positions = [x + 1 + f for x, f in zip(self.positions, fast, strict=True)]
        earned = [1.0 + f * self.gains[self.t] for f in fast]
        if self.shared:
            earned = [sum(earned)] * 2
        costs = [f * cost for f, cost in zip(fast, self.agent_costs, strict=True)]
        self.t += 1
        over = self.t == self.length
        if over:
            self.agents = []
        return (
            self._observations(),
            dict(zip(AGENTS, earned, strict=True)),
            dict.fromkeys(AGENTS, over and self.end != "truncated"),
            dict.fromkeys(AGENTS, over and self.end != "terminated"),
            {agent: self._info(cost) for agent, cost in zip(AGENTS, costs, strict=True)},
        )

    def _observations(self) -> dict[str, np.ndarray]:
        left, right = self.positions
        rows = ([left, right, self.t], [right, left, self.t])
        return {a: np.array(row, np.float32) for a, row in zip(AGENTS, rows, strict=True)}

    def _info(self, cost: float | None = None) -> dict[str, Any]:
        info: dict[str, Any] = {}
        if cost is not None and self.n_costs == 1:
            info["cost"] = cost
        elif cost is not None and self.n_costs > 1:
            info["cost"] = [(j + 1) * cost for j in range(self.n_costs)]
        if self.critic_state:
            info["critic_state"] = np.array([self.t / self.length], np.float32)
        return info

    def render(self) -> np.ndarray:
        return np.full((2, 3, 3), self.start, np.uint8)

    def close(self) -> None:
        self.closed = True


class TwoOnManyLines:
    """All worlds of :class:`TwoOnALine` in one set of arrays, written on its own."""

    def __init__(self, n_worlds: int, **parameters: Any):
        one = TwoOnALine(**parameters)
        self.parameters, self.n_worlds = parameters, n_worlds
        self.possible_agents, self.metadata = one.possible_agents, one.metadata
        self.render_mode, self.one = one.render_mode, one
        self.gains, self.agent_costs = np.array(one.gains), np.array(one.agent_costs)
        self.rngs = [np.random.default_rng() for _ in range(n_worlds)]
        self.start, self.t = np.zeros((2, n_worlds), np.int64)
        self.length = np.full(n_worlds, one.length)
        self.positions = np.zeros((n_worlds, 2))
        self.closed = False

    def observation_space(self, agent: str) -> spaces.Box:
        return self.one.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Discrete:
        return self.one.action_space(agent)

    def reset(
        self,
        worlds: np.ndarray,
        seeds: Sequence[int | None],
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        for world, seed in zip(worlds, seeds, strict=True):
            if seed is not None:
                self.rngs[world] = np.random.default_rng(seed)
            self.start[world] = self.rngs[world].integers(self.one.spread)
        for name in {"length", "start"} & set(options or {}):
            getattr(self, name)[worlds] = options[name]
        self.positions[worlds] = self.start[worlds, None] + np.arange(2)
        self.t[worlds] = 0
        start = np.repeat(self.start[worlds, None], 2, axis=1)
        return self._observations()[worlds], {"start": start} | self._critic_state(worlds)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        self.positions += 1 + actions
        rewards = 1 + actions * self.gains[self.t, None]
        if self.one.shared:
            rewards = np.repeat(rewards.sum(axis=1, keepdims=True), 2, axis=1)
        self.t += 1
        over = self.t == self.length
        terminated = over & (self.one.end != "truncated")
        truncated = over & (self.one.end != "terminated")
        infos = self._costs(actions) | self._critic_state(np.arange(self.n_worlds))
        return self._observations(), rewards.astype(np.float32), terminated, truncated, infos

    def _observations(self) -> np.ndarray:
        time = np.repeat(self.t[:, None], 2, axis=1)
        views = (self.positions, self.positions[:, ::-1], time)
        return np.stack(views, axis=-1).astype(np.float32)

    def _costs(self, actions: np.ndarray) -> dict[str, np.ndarray]:
        costs = actions * self.agent_costs
        if self.one.n_costs == 0:
            return {}
        if self.one.n_costs == 1:
            return {"cost": costs}
        return {"cost": costs[..., None] * np.arange(1, self.one.n_costs + 1)}

    def _critic_state(self, worlds: np.ndarray) -> dict[str, np.ndarray]:
        if not self.one.critic_state:
            return {}
        progress = (self.t / self.length)[worlds].astype(np.float32)
        return {"critic_state": np.repeat(progress[:, None, None], 2, axis=1)}

    def render(self, world: int) -> np.ndarray:
        return np.full((2, 3, 3), self.start[world], np.uint8)

    def close(self) -> None:
        self.closed = True


@pytest.fixture(name="two_on_a_line")
def fixture_two_on_a_line() -> type[TwoOnALine]:
    """The environment's class, for tests that choose its parameters."""
    return TwoOnALine
