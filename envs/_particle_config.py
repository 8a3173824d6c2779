"""What the particle tasks are made of: agents, bodies, views, starts, and their checks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

COST_WITH = ("teammates", "obstacles", "adversary")


class Body(NamedTuple):
    """Physical properties of one kind of entity, as mpe2 sets them."""

    size: float
    collides: bool
    acceleration: float = 5.0
    max_speed: float = np.inf


class View(NamedTuple):
    """What an observation has besides the relative positions of all landmarks and other agents."""

    velocity: bool = False
    position: bool = False
    goal: bool = False
    colors: bool = False
    prey_velocity: bool = False


@dataclass(frozen=True)
class ParticleTask:
    """One of the three tasks. World order: agents named adversary, agents named agent, landmarks.

    ``mpe2`` is the module with the ``raw_env`` of the reference, and its parameters.
    """

    name: str
    team: tuple[str, ...]
    opponents: tuple[str, ...]
    team_body: Body
    opponent_body: Body
    landmark_body: Body
    n_landmarks: int
    team_view: View
    opponent_view: View
    cost_with: tuple[str, ...]
    mpe2: tuple[str, Mapping[str, Any]]
    has_goal: bool = True
    landmark_range: float = 1.0

    @property
    def agents(self) -> list[str]:
        """Names of the agents in world order."""
        return sorted(self.team + self.opponents)

    @property
    def groups(self) -> dict[str, list[str]]:
        """Names of the agents by role."""
        return {"team": list(self.team), "opponents": list(self.opponents)}

    @property
    def members(self) -> dict[str, slice]:
        """Where the agents of a group stand in world order; they are neighbors there."""
        starts = {group: self.agents.index(names[0]) for group, names in self.groups.items()}
        return {g: slice(start, start + len(self.groups[g])) for g, start in starts.items()}

    @property
    def bodies(self) -> list[Body]:
        """Bodies of all entities in world order."""
        agents = [self.team_body if a in self.team else self.opponent_body for a in self.agents]
        return agents + [self.landmark_body] * self.n_landmarks

    @property
    def observation_sizes(self) -> dict[str, int]:
        """Observation size D of every group."""
        common = 2 * (len(self.agents) - 1 + self.n_landmarks)
        pairs = {"team": self.team_view, "opponents": self.opponent_view}
        extra = {g: 2 * sum(v) + v.colors * (1 + 3 * self.n_landmarks) for g, v in pairs.items()}
        return {group: common + size for group, size in extra.items()}

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of the environment and of its simulator."""
        return {
            "name": self.name,
            "render_modes": ["rgb_array"],
            "render_fps": 10,
            "is_parallelizable": True,
            "team_return": "sum",
            "team_cost": "sum",
            **self.groups,
        }


@dataclass(frozen=True)
class ParticleConfig:
    """A task and its parameters; what these do stands in the docstrings of the environments."""

    task: ParticleTask
    max_cycles: int = 80
    continuous_actions: bool = False
    cost_with: Iterable[str] | None = field(default=None)

    def __post_init__(self) -> None:
        cycles = self.max_cycles
        if not isinstance(cycles, Integral) or isinstance(cycles, bool) or cycles < 1:
            raise ValueError(f"max_cycles is {cycles!r}; expected an integer of at least 1")
        if not isinstance(self.continuous_actions, bool):
            raise ValueError(
                f"continuous_actions is {self.continuous_actions!r}; expected True or False"
            )
        object.__setattr__(self, "cost_with", self._cost_with())

    def _cost_with(self) -> tuple[str, ...]:
        given = self.task.cost_with if self.cost_with is None else self.cost_with
        names = () if isinstance(given, str) else tuple(given)
        if not names or not set(names) <= set(COST_WITH):
            raise ValueError(
                f"cost_with is {given!r}; expected a list with at least one of {COST_WITH}"
            )
        if "obstacles" in names and not self.task.landmark_body.collides:
            raise ValueError(
                f"cost_with is {given!r}, but the landmarks of {self.task.name} are no obstacles; "
                "leave 'obstacles' out"
            )
        return tuple(name for name in COST_WITH if name in names)

    @property
    def counted(self) -> np.ndarray:
        """Whether contact of an agent with an entity costs, bool (agents, entities)."""
        task = self.task
        agents = task.agents
        counted = np.zeros((len(agents), len(task.bodies)), dtype=bool)
        names = set(self.cost_with or ())
        for i in (agents.index(name) for name in task.team):
            counted[i, task.members["team"]] = "teammates" in names
            counted[i, task.members["opponents"]] = "adversary" in names
            counted[i, len(agents) :] = "obstacles" in names
            counted[i, i] = False
        return counted


class Start(NamedTuple):
    """Random part of the starts of R worlds."""

    goals: np.ndarray  # (R,) int64, 0 where there is no goal
    positions: np.ndarray  # (R, entities, 2)


def draw_starts(task: ParticleTask, rngs: Sequence[np.random.Generator]) -> Start:
    """Starts of R worlds, each from its own stream in the order in which mpe2 draws them."""
    goals = np.zeros(len(rngs), dtype=np.int64)
    positions = np.empty((len(rngs), len(task.bodies), 2))
    for world, rng in enumerate(rngs):
        if task.has_goal:
            goals[world] = rng.integers(task.n_landmarks)
        rng.random(out=positions[world])
    # What rng.uniform(-reach, reach) makes of the same draws; it takes five times as long.
    reach = np.ones((len(task.bodies), 1))
    reach[len(task.agents) :] = task.landmark_range
    return Start(goals, -reach + 2.0 * reach * positions)


def place(task: ParticleTask, start: Start, options: Mapping[str, Any] | None) -> None:
    """Put what ``options`` names where it says; edits the start.

    :param options: "agents" (4, 2) or (R, 4, 2) and "landmarks" (K, 2) or (R, K, 2) in world order,
        "goal", a number or (R,); other keys are ignored
    """
    n_agents = len(task.agents)
    parts = {"agents": start.positions[:, :n_agents], "landmarks": start.positions[:, n_agents:]}
    given = {key: options[key] for key in parts if options and options.get(key) is not None}
    for key, positions in given.items():
        array, shape = np.asarray(positions, dtype=np.float64), parts[key].shape
        if array.shape not in (shape, shape[1:]) or not np.isfinite(array).all():
            raise ValueError(
                f"options[{key!r}] has shape {array.shape}; expected finite numbers, {shape[1:]}, "
                f"or {shape} to place every world differently"
            )
        parts[key][:] = array
    if given:
        _check_apart(task, start.positions)
    goal = options.get("goal") if options else None
    if goal is not None:
        goals = np.asarray(goal)
        in_range = goals.dtype.kind in "iu" and ((goals >= 0) & (goals < task.n_landmarks)).all()
        if not task.has_goal or not in_range or goals.shape not in ((), start.goals.shape):
            expected = f"a landmark, 0 to {task.n_landmarks - 1}" if task.has_goal else "no goal"
            raise ValueError(f"options['goal'] is {goal!r}; {task.name} expects {expected}")
        start.goals[:] = goals


def _check_apart(task: ParticleTask, positions: np.ndarray) -> None:
    """Contact at distance zero has no direction: mpe2 divides by zero there."""
    solid = [i for i, body in enumerate(task.bodies) if body.collides]
    for n, i in enumerate(solid):
        for j in solid[n + 1 :]:
            if (positions[:, i] == positions[:, j]).all(axis=-1).any():
                raise ValueError(
                    f"the options put entities {i} and {j} (agents first, then landmarks) at the "
                    "same point; expected different points for bodies that push each other"
                )


_GOOD = ("agent_0", "agent_1", "agent_2")
_ADVERSARIES = ("adversary_0", "adversary_1", "adversary_2")

PHYSICAL_DECEPTION = ParticleTask(
    name="physical_deception_v0",
    team=_GOOD,
    opponents=("adversary_0",),
    team_body=Body(0.15, collides=False),
    opponent_body=Body(0.15, collides=False),
    landmark_body=Body(0.08, collides=False),
    n_landmarks=3,
    team_view=View(goal=True),
    opponent_view=View(),
    cost_with=("teammates",),
    mpe2=("mpe2.simple_adversary_v3", {"N": 3}),
)

KEEP_AWAY = ParticleTask(
    name="keep_away_v0",
    team=_GOOD,
    opponents=("adversary_0",),
    team_body=Body(0.05, collides=True),
    opponent_body=Body(0.05, collides=True),
    landmark_body=Body(0.05, collides=False),
    n_landmarks=2,
    team_view=View(velocity=True, goal=True, colors=True),
    opponent_view=View(velocity=True),
    cost_with=("teammates",),
    mpe2=("sb3_e2c.envs._particle_keep_away", {}),
)

PREDATOR_PREY = ParticleTask(
    name="predator_prey_v0",
    team=_ADVERSARIES,
    opponents=("agent_0",),
    team_body=Body(0.075, collides=True, acceleration=3.0, max_speed=1.0),
    opponent_body=Body(0.05, collides=True, acceleration=4.0, max_speed=1.3),
    landmark_body=Body(0.2, collides=True),
    n_landmarks=2,
    team_view=View(velocity=True, position=True, prey_velocity=True),
    opponent_view=View(velocity=True, position=True),
    cost_with=("teammates", "obstacles"),
    mpe2=("mpe2.simple_tag_v3", {"num_good": 1, "num_adversaries": 3, "num_obstacles": 2}),
    has_goal=False,
    landmark_range=0.9,
)

TASKS = (PHYSICAL_DECEPTION, KEEP_AWAY, PREDATOR_PREY)
