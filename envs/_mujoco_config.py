"""Parameters of the robot tasks and their checks, and which agent drives which motor."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from numbers import Integral, Real
from typing import Any

import numpy as np

METADATA: dict[str, Any] = {
    "name": "safe_mamujoco_v0",
    "render_modes": ["rgb_array"],
    "render_fps": 20,
    "is_parallelizable": True,
    "team_return": "shared",
    "team_cost": "max",
}

# Motors in the order of gymnasium's XML files, named like the nodes of gymnasium-robotics.
MOTORS = {
    "Ant": ["hip4", "ankle4", "hip1", "ankle1", "hip2", "ankle2", "hip3", "ankle3"],
    "HalfCheetah": ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"],
}

# What each agent drives: the factorizations of gymnasium-robotics, continued to 8x1 and 3x2.
SPLITS = {
    "Ant": {
        "2x4": ("hip1 ankle1 hip2 ankle2", "hip3 ankle3 hip4 ankle4"),
        "2x4d": ("hip1 ankle1 hip4 ankle4", "hip2 ankle2 hip3 ankle3"),
        "4x2": ("hip1 ankle1", "hip2 ankle2", "hip3 ankle3", "hip4 ankle4"),
        "8x1": ("hip1", "ankle1", "hip2", "ankle2", "hip3", "ankle3", "hip4", "ankle4"),
    },
    "HalfCheetah": {
        "2x3": ("bthigh bshin bfoot", "fthigh fshin ffoot"),
        "3x2": ("bthigh bshin", "bfoot fthigh", "fshin ffoot"),
        "6x1": ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"),
    },
}

# Speed in m/s above which a step costs, from Safety-Gymnasium's multi-agent velocity tasks.
SPEED_LIMITS = {
    ("Ant", "2x4"): 2.522,
    ("Ant", "4x2"): 2.418,
    ("HalfCheetah", "2x3"): 3.227,
    ("HalfCheetah", "6x1"): 2.932,
}

_CHOICES = {
    "scenario": tuple(SPLITS),
    "obs_mode": ("full", "obsk"),
    "walls": ("visual", "free", "none"),
    "cost_mode": ("hazard", "velocity"),
}
_FLAGS = ("add_id", "strict_outside", "legacy_split", "per_vector_norm")


@dataclass(frozen=True)
class RobotConfig:
    """Parameters of a robot task; what they do stands in the docstring of the environment."""

    scenario: str = "HalfCheetah"
    agent_conf: str | None = None
    obs_mode: str = "full"
    agent_obsk: int = 1
    add_id: bool = True
    max_steps: int = 2000
    walls: str = "visual"
    strict_outside: bool = False
    legacy_split: bool = False
    per_vector_norm: bool = False
    cost_mode: str = "hazard"
    speed_limit: float | None = None
    n_threads: int | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected one of {choices}")
        for name in _FLAGS:
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected True or False")
        _check_count("max_steps", self.max_steps, 1)
        _check_count("agent_obsk", self.agent_obsk, 0)
        if self.n_threads is not None:
            _check_count("n_threads", self.n_threads, 1)
        self._check_split()
        self._check_combination()
        self._check_speed_limit()

    def _check_split(self) -> None:
        known = SPLITS[self.scenario]
        if self.agent_conf is None:
            object.__setattr__(self, "agent_conf", next(iter(known)))
        if self.agent_conf not in known:
            raise ValueError(
                f"agent_conf is {self.agent_conf!r}; expected one of {tuple(known)} for "
                f"{self.scenario}"
            )

    def _check_combination(self) -> None:
        if self.scenario != "Ant" and self.walls == "free":
            raise ValueError(
                f"walls is 'free' with {self.scenario}, whose walls nothing can reach; expected "
                "'visual' or 'none'"
            )
        if self.strict_outside and (self.scenario != "Ant" or self.cost_mode != "hazard"):
            raise ValueError(
                f"strict_outside is True with {self.scenario} and cost_mode {self.cost_mode!r}; "
                "expected the Ant's walls, cost_mode='hazard'"
            )
        if self.agent_obsk != 1 and self.obs_mode != "obsk":
            raise ValueError(
                f"agent_obsk is {self.agent_obsk} with obs_mode {self.obs_mode!r}, in which every "
                "agent sees everything; expected obs_mode='obsk'"
            )
        if self.per_vector_norm and self.obs_mode != "full":
            raise ValueError(
                f"per_vector_norm is True with obs_mode {self.obs_mode!r}; expected 'full', the "
                "only observation that the original standardizes"
            )

    def _check_speed_limit(self) -> None:
        limit = self.speed_limit
        if self.cost_mode == "hazard":
            if limit is not None:
                raise ValueError(
                    f"speed_limit is {limit} with cost_mode 'hazard', which has none; use "
                    "cost_mode='velocity'"
                )
            return
        if limit is None:
            limit = SPEED_LIMITS.get((self.scenario, str(self.agent_conf)))
            object.__setattr__(self, "speed_limit", limit)
        if limit is None:
            raise ValueError(
                f"no speed limit was published for {self.scenario} {self.agent_conf}; give "
                "speed_limit in m/s"
            )
        is_number = isinstance(limit, Real) and not isinstance(limit, bool)
        if not is_number or not isfinite(limit) or limit <= 0:
            raise ValueError(f"speed_limit is {limit!r}; expected a number above 0, in m/s")

    @property
    def has_hazards(self) -> bool:
        """Whether walls or a bomb cost, rather than speed."""
        return self.cost_mode == "hazard"

    @property
    def partition(self) -> list[list[str]]:
        """The motors of every agent. The original joined actions in the order of the XML file."""
        names = [agent.split() for agent in SPLITS[self.scenario][str(self.agent_conf)]]
        if not self.legacy_split:
            return names
        motors = iter(MOTORS[self.scenario])
        return [[next(motors) for _ in agent] for agent in names]

    @property
    def agents(self) -> list[str]:
        """Names of the agents."""
        return [f"agent_{i}" for i in range(len(self.partition))]

    @property
    def action_order(self) -> np.ndarray:
        """For every motor in XML order, its place in the agents' joined actions, shape (U,)."""
        joined = [motor for agent in self.partition for motor in agent]
        return np.array([joined.index(motor) for motor in MOTORS[self.scenario]])


def _check_count(name: str, value: object, least: int) -> None:
    if not isinstance(value, Integral) or isinstance(value, bool) or int(value) < least:
        raise ValueError(f"{name} is {value!r}; expected an integer of at least {least}")
