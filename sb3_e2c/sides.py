"""Worlds in which two sides act: a team, and opponents with spaces of their own.

    ParallelEnv ─► PaddedWorld ─► SuperSuit's rows, cut ─► PaddedSides ─┐
    ParallelEnv.batched_groups(W) ───────────────────────► BatchedSides ┴─► Step, Step

Both give the same trajectories for the same seeds. W worlds have W·n slots on each side, where n
agents act on that side and slot = world·n + agent.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from typing_extensions import override

from sb3_e2c.checks import Form, check_parts, check_simulator
from sb3_e2c.world import MakeEnv, World, as_float32, check_spaces, new_env
from sb3_e2c.worlds import (
    Infos,
    Step,
    SuperSuitWorlds,
    WorkerWorlds,
    batched_step,
    begin,
    begun,
    ended_worlds,
    reset_all,
)

GROUPS = ("team", "opponents")


class Side(NamedTuple):
    """Agents that share a policy."""

    agents: list[str]
    observation_space: spaces.Space
    action_space: spaces.Space


def side(env: Any, agents: list[str]) -> Side:
    """Agents of an environment or simulator, and their spaces.

    :param env: Knows their spaces
    :param agents: Names; their spaces are equal
    """
    space = as_float32(env.observation_space(agents[0]))
    return Side(agents, space, env.action_space(agents[0]))


class GroupedSimulator(Protocol):
    """What ``ParallelEnv.batched_groups(n_worlds)`` returns: W worlds in one set of arrays.

    As :class:`sb3_e2c.worlds.BatchedSimulator`, but what belongs to agents is a dict of arrays by
    group, "team" and "opponents": observations (W, n, D), rewards (W, n), infos by group and name.
    """

    n_worlds: int
    groups: dict[str, list[str]]
    render_mode: str | None
    metadata: dict[str, Any]

    def observation_space(self, agent: str) -> spaces.Space:
        """Observation space of an agent, the same for all of its group."""

    def action_space(self, agent: str) -> spaces.Space:
        """Action space of an agent, the same for all of its group."""

    def reset(
        self, worlds: np.ndarray, seeds: Sequence[int | None], options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
        """Start an episode in R worlds: observations and infos."""

    def step(self, actions: dict[str, np.ndarray]) -> tuple[Any, Any, np.ndarray, np.ndarray, Any]:
        """Step all worlds without any reset.

        :param actions: Shape (W, n, ...) by group
        :return: observations, rewards, terminated (W,), truncated (W,), infos; all of them fresh
        """

    def render(self, world: int) -> np.ndarray:
        """Picture of one world, uint8 (height, width, 3)."""

    def close(self) -> None:
        """Release what the simulator holds."""


class Sides(ABC):
    """W worlds that begin a new episode by themselves, seen from both sides.

    :param n_worlds: W
    :param team: The agents that are trained
    :param opponents: The others
    """

    shared_owner = False

    def __init__(self, n_worlds: int, team: Side, opponents: Side):
        self.n_worlds, self.team, self.opponents = n_worlds, team, opponents

    @property
    @abstractmethod
    def source(self) -> Any:
        """What knows ``metadata`` and ``render_mode``, makes pictures and closes the worlds."""

    @property
    def failed(self) -> bool:
        """Whether a worker process died."""
        return getattr(self.source, "failed", False)

    @abstractmethod
    def reset(
        self, seeds: Sequence[int | None], options: Infos
    ) -> tuple[tuple[np.ndarray, Infos], tuple[np.ndarray, Infos]]:
        """Reset all worlds: observations (W·n, D) and infos of the team, then the opponents'."""

    @abstractmethod
    def step_async(self, team: np.ndarray, opponents: np.ndarray) -> None:
        """Begin a step with the actions (W·n, ...) of both."""

    @abstractmethod
    def step_wait(self) -> tuple[Step, Step]:
        """Finish the step: what the team sees of it, then the opponents."""

    @abstractmethod
    def images(self) -> list[Any]:
        """Render every world."""

    @abstractmethod
    def owner(self, world: int) -> Any:
        """Object that holds the attributes of a world."""

    def close(self) -> None:
        """Release all worlds."""
        self.source.close()


class BatchedSides(Sides):
    """All worlds in one simulator.

    Infos of opponents are left out: who acts for them does not look at any.
    """

    shared_owner = True

    def __init__(self, sim: GroupedSimulator):
        team, opponents = (side(sim, list(sim.groups[group])) for group in GROUPS)
        super().__init__(sim.n_worlds, team, opponents)
        self.sim = sim
        self._forms = {
            group: Form(sim.n_worlds, len(each.agents), each.observation_space)
            for group, each in zip(GROUPS, (team, opponents), strict=True)
        }

    @property
    @override
    def source(self) -> GroupedSimulator:
        return self.sim

    @override
    def reset(
        self, seeds: Sequence[int | None], options: Infos
    ) -> tuple[tuple[np.ndarray, Infos], tuple[np.ndarray, Infos]]:
        parts = reset_all(self.sim, seeds, options)
        team = [(observations["team"], infos["team"]) for observations, infos in parts]
        others = [(observations["opponents"], dict[str, Any]()) for observations, _ in parts]
        return begun(team, self._forms["team"]), begun(others, self._forms["opponents"])

    @override
    def step_async(self, team: np.ndarray, opponents: np.ndarray) -> None:
        self._actions = {
            group: actions.reshape(self.n_worlds, -1, *actions.shape[1:])
            for group, actions in zip(GROUPS, (team, opponents), strict=True)
        }

    @override
    def step_wait(self) -> tuple[Step, Step]:
        answer = check_parts("step", self.sim.step(self._actions), 5)
        observations, rewards, terminated, truncated, infos = answer
        columns = {"team": infos["team"], "opponents": {}}
        team, opponents = (
            batched_step(f, observations[g], rewards[g], terminated, truncated, columns[g])
            for g, f in self._forms.items()
        )
        ended = ended_worlds(team, len(self.team.agents))
        if len(ended):
            answer = self.sim.reset(ended, [None] * len(ended), None)
            first, first_infos = check_parts("reset", answer, 2)
            begin(team, ended, self._forms["team"], first["team"], first_infos["team"])
            begin(opponents, ended, self._forms["opponents"], first["opponents"], {})
        return team, opponents

    @override
    def images(self) -> list[Any]:
        return [self.sim.render(world) for world in range(self.n_worlds)]

    @override
    def owner(self, world: int) -> Any:
        return self.sim


class PaddedWorld(World):
    """A world whose sides differ in their spaces: shorter observations are filled up with zeros.

    :param env: Environment whose agents all end in the same step
    :param index: Number of the world
    :param agents: Names of the team and of the opponents
    :raises ValueError: if agents of one side differ in their spaces, or rows cannot be padded
    """

    def __init__(self, env: ParallelEnv, index: int, agents: tuple[list[str], list[str]]):
        self.sides = agents
        super().__init__(env, index)

    @override
    def _order(self, agents: list[str]) -> list[str]:
        return [agent for names in self.sides for agent in names]

    @override
    def _common_spaces(self) -> tuple[spaces.Space, spaces.Space]:
        for names in self.sides:
            check_spaces(self.env, names)
        team, opponents = (side(self.env, names) for names in self.sides)
        return (
            _padded("observation", team.observation_space, opponents.observation_space),
            _padded("action", team.action_space, opponents.action_space),
        )

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Step with the part of each row that is the agent's action."""
        return super().step({agent: self._own(agent, row) for agent, row in actions.items()})

    def _own(self, agent: str, row: Any) -> Any:
        space = self.env.action_space(agent)
        return row[: space.shape[0]] if isinstance(space, spaces.Box) and space.shape else row

    @override
    def _observations(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        native = super()._observations(observations)
        if not isinstance(self._space, spaces.Box):
            return native
        return {agent: _filled(obs, self._space.shape) for agent, obs in native.items()}


class PaddedSides(Sides):
    """Worlds flattened by SuperSuit with all their agents, whose rows are cut apart again.

    :param rows: The worlds, the team's agents first in each
    :param env: One of the environments, which knows the spaces
    :param agents: Names of the team and of the opponents
    """

    def __init__(
        self, rows: SuperSuitWorlds, env: ParallelEnv, agents: tuple[list[str], list[str]]
    ):
        team, opponents = (side(env, names) for names in agents)
        super().__init__(rows.n_worlds, team, opponents)
        self.rows = rows
        grid = np.arange(rows.n_worlds * len(rows.agents)).reshape(rows.n_worlds, -1)
        self._slots = (grid[:, : len(team.agents)].ravel(), grid[:, len(team.agents) :].ravel())

    @property
    @override
    def source(self) -> SuperSuitWorlds:
        return self.rows

    @override
    def reset(
        self, seeds: Sequence[int | None], options: Infos
    ) -> tuple[tuple[np.ndarray, Infos], tuple[np.ndarray, Infos]]:
        observations, infos = self.rows.reset(seeds, options)
        team, opponents = (
            (_cut(observations[slots], each.observation_space), [infos[slot] for slot in slots])
            for slots, each in zip(self._slots, (self.team, self.opponents), strict=True)
        )
        return team, opponents

    @override
    def step_async(self, team: np.ndarray, opponents: np.ndarray) -> None:
        space = self.rows.action_space
        joint = np.zeros((len(team) + len(opponents), *space.shape), space.dtype)
        for slots, actions in zip(self._slots, (team, opponents), strict=True):
            if joint.ndim == 2:
                joint[slots, : actions.shape[1]] = actions
            else:
                joint[slots] = actions
        self.rows.step_async(joint)

    @override
    def step_wait(self) -> tuple[Step, Step]:
        step = self.rows.step_wait()
        team, opponents = (
            _part(step, slots, each.observation_space)
            for slots, each in zip(self._slots, (self.team, self.opponents), strict=True)
        )
        return team, opponents

    @override
    def images(self) -> list[Any]:
        return self.rows.images()

    @override
    def owner(self, world: int) -> Any:
        return self.rows.owner(world)


def make_sides(
    make_env: MakeEnv,
    example: ParallelEnv,
    agents: tuple[list[str], list[str]],
    n_worlds: int,
    n_processes: int,
    timeout: float | None,
    batched: bool,
) -> Sides:
    """Worlds with two sides.

    :param make_env: Makes an environment
    :param example: One that it has made
    :param agents: Names of the team and of the opponents
    :param n_worlds: W
    :param n_processes: Among which SuperSuit divides the worlds
    :param timeout: Seconds to wait for a worker process
    :param batched: Whether to use the environment's own simulator
    """
    if batched:
        sim = example.batched_groups(n_worlds)
        return BatchedSides(check_simulator(sim, n_worlds, example.possible_agents))
    new_world = partial(PaddedWorld, agents=agents)
    rows: SuperSuitWorlds
    if n_processes == 1:
        envs = [example, *(new_env(make_env) for _ in range(n_worlds - 1))]
        rows = SuperSuitWorlds(envs, new_world)
    else:
        examples = [example, new_env(make_env)]
        rows = WorkerWorlds(make_env, examples, n_worlds, n_processes, new_world, timeout)
    return PaddedSides(rows, example, agents)


def _padded(kind: str, team: spaces.Space, opponents: spaces.Space) -> spaces.Space:
    """The smallest space that holds a row of either side."""
    if team == opponents and not isinstance(team, (spaces.Dict, spaces.Tuple)):
        return team
    if isinstance(team, spaces.Discrete) and isinstance(opponents, spaces.Discrete):
        return spaces.Discrete(max(int(team.n), int(opponents.n)))
    both = (team, opponents)
    if all(isinstance(space, spaces.Box) and len(space.shape) == 1 for space in both):
        width = max(team.shape[0], opponents.shape[0])  # type: ignore[index]
        return spaces.Box(-np.inf, np.inf, (width,), np.float32)
    raise ValueError(
        f"the {kind} spaces of the team and of its opponents are {team} and {opponents}; expected "
        "two vectors (Box), two of type Discrete, or equal ones (not Dict, not Tuple). Wrap the "
        "environment, for example to flatten them"
    )


def _filled(observation: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if observation.shape == shape:
        return observation
    row = np.zeros(shape, np.float32)
    row[: len(observation)] = observation
    return row


def _cut(rows: Any, space: spaces.Space) -> np.ndarray:
    """A side's own part of padded observations, as a copy."""
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        rows = rows[..., : space.shape[0]].astype(space.dtype)
    return rows


def _part(step: Step, slots: np.ndarray, space: spaces.Space) -> Step:
    """One side's slots of a step, renumbered."""
    infos = [step.infos[slot] for slot in slots]
    for info in infos:
        if "terminal_observation" in info:
            info["terminal_observation"] = _cut(info["terminal_observation"], space)
    return Step(
        _cut(step.observations[slots], space),
        step.rewards[slots],
        step.terminated[slots],
        step.truncated[slots],
        infos,
        {new: step.reset_infos[s] for new, s in enumerate(slots) if s in step.reset_infos},
    )
