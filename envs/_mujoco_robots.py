"""What the two robots observe, earn, cost and survive: formulas over arrays of worlds.

Rewards and ends follow gymnasium's ``Ant`` and ``HalfCheetah``, hazards the public repository
Safe-Multi-Agent-MuJoCo, speed limits Safety-Gymnasium.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from sb3_e2c.envs._mujoco_config import MOTORS, RobotConfig
from sb3_e2c.envs._mujoco_hazards import (
    bomb_control,
    bomb_cost,
    corridor_offset,
    wall_cost,
)

FRAME_SKIP = 5  # simulation steps of 0.01 s in one step of the environment
SECONDS = 0.05  # of one step of the environment


class Snapshot(NamedTuple):
    """What is read from W worlds after a step or a reset.

    MuJoCo integrates last, so that ``torso`` and ``bomb`` are one simulation step (0.01 s) older
    than ``qpos`` after a step. The original environments read them, and so is it done here.
    """

    time: np.ndarray  # (W,) s
    qpos: np.ndarray  # (W, nq) m, rad, quaternions
    qvel: np.ndarray  # (W, nv) m/s, rad/s
    torso: np.ndarray  # (W, 3) m
    bomb: np.ndarray  # (W,) m, x; nan without bomb
    contact: np.ndarray  # (W, bodies * 6) N and N m, external forces on bodies


class Verdict(NamedTuple):
    """What a step was worth in W worlds."""

    rewards: np.ndarray  # (W,)
    costs: np.ndarray  # (W,)
    terminated: np.ndarray  # (W,) bool
    infos: dict[str, np.ndarray]  # (W,) each


class Robot(ABC):
    """One robot, many worlds.

    :param config: parameters of the task
    """

    n_qpos: int  # of the robot alone, which comes first in qpos
    n_qvel: int
    needs_contact = False

    def __init__(self, config: RobotConfig) -> None:
        self.config = config
        self.n_motors = len(MOTORS[config.scenario])

    @property
    def n_noisy(self) -> tuple[int, int]:
        """How many positions and velocities are random at the start."""
        return self.n_qpos, self.n_qvel

    @abstractmethod
    def controls(self, motors: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Inputs of all motors of the model, held for one step.

        :param motors: inputs of the robot's motors in [-1, 1], shape (W, U)
        :param time: before the step, shape (W,)
        """

    @abstractmethod
    def hazard_view(self, now: Snapshot) -> np.ndarray:
        """What the robot sees of walls or bomb, shape (W, H)."""

    @abstractmethod
    def proprioception(self, now: Snapshot) -> list[np.ndarray]:
        """Own positions and velocities, shape (W, P) together."""

    def state(self, now: Snapshot) -> np.ndarray:
        """State vector of the task, shape (W, P + H)."""
        return np.concatenate([*self.proprioception(now), self.hazard_view(now)], axis=1)

    def judge(self, before: Snapshot, now: Snapshot, motors: np.ndarray) -> Verdict:
        """Rewards, costs and ends of one step.

        :param before: worlds before the step
        :param now: worlds after it
        :param motors: inputs of the robot's motors, shape (W, U)
        """
        along, across = self._velocity(before, now)
        terminated = self._is_over(now)
        place = self.whereabouts(now)
        rewards = {"reward_forward": along} | self._earnings(now, motors, terminated)
        if self.config.has_hazards:
            costs, parts = self._hazards(place, terminated)
        else:
            speed = np.hypot(along, across)
            costs, parts = (speed > self.config.speed_limit) * 1.0, {"speed": speed}
        infos = {"cost": costs} | place | parts | rewards
        return Verdict(sum(rewards.values(), np.zeros(1)), costs, terminated, infos)

    @abstractmethod
    def _velocity(self, before: Snapshot, now: Snapshot) -> tuple[np.ndarray, np.ndarray]:
        """Mean velocity of the step along x and y in m/s, shape (W,) each."""

    @abstractmethod
    def _earnings(
        self, now: Snapshot, motors: np.ndarray, terminated: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Parts of the reward besides the progress, shape (W,) each."""

    @abstractmethod
    def _is_over(self, now: Snapshot) -> np.ndarray:
        """Whether the robot has fallen, shape (W,)."""

    @abstractmethod
    def _hazards(
        self, place: dict[str, np.ndarray], terminated: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Cost (W,) of walls or bomb, and its parts, given :meth:`whereabouts`."""

    @abstractmethod
    def whereabouts(self, now: Snapshot) -> dict[str, np.ndarray]:
        """Infos that steps and resets have in common, shape (W,) each."""


class Ant(Robot):
    """Four legs in a corridor that bends."""

    n_qpos, n_qvel = 15, 14
    needs_contact = True

    def controls(self, motors: np.ndarray, time: np.ndarray) -> np.ndarray:  # noqa: ARG002
        """The motors are all there is."""
        return motors

    def proprioception(self, now: Snapshot) -> list[np.ndarray]:
        """Height, orientation, joints (13), and all velocities (14)."""
        return [now.qpos[:, 2:15], now.qvel[:, :14]]

    def hazard_view(self, now: Snapshot) -> np.ndarray:
        """X / 5 m and the offset from the center line in m; nothing without corridor."""
        if not self.config.has_hazards:
            return np.empty((len(now.time), 0))
        x, y = now.qpos[:, 0], now.qpos[:, 1]
        return _side_by_side(x / 5.0, corridor_offset(x, y))

    def whereabouts(self, now: Snapshot) -> dict[str, np.ndarray]:
        """Position, and the offset from the center line of the corridor."""
        x, y = now.torso[:, 0], now.torso[:, 1]
        place = {"x_position": x, "y_position": y}
        return place | ({"y_offset": corridor_offset(x, y)} if self.config.has_hazards else {})

    def _velocity(self, before: Snapshot, now: Snapshot) -> tuple[np.ndarray, np.ndarray]:
        velocity = (now.torso[:, :2] - before.torso[:, :2]) / SECONDS
        return velocity[:, 0], velocity[:, 1]

    def _earnings(
        self, now: Snapshot, motors: np.ndarray, terminated: np.ndarray
    ) -> dict[str, np.ndarray]:
        # Gymnasium pays nothing for the step of the fall, the original 1 as always.
        survived = np.ones(len(motors)) if self.config.has_hazards else 1.0 - terminated
        return {
            "reward_survive": survived,
            "reward_ctrl": -0.5 * np.square(motors).sum(axis=1),
            "reward_contact": -5e-4 * np.square(clipped(now.contact, 1.0)).sum(axis=1),
        }

    def _is_over(self, now: Snapshot) -> np.ndarray:
        finite = np.isfinite(now.qpos).all(axis=1) & np.isfinite(now.qvel).all(axis=1)
        height = now.qpos[:, 2]
        healthy = finite & (height >= 0.2) & (height <= 1.0)
        if self.config.has_hazards:
            # z component of the torso's upward axis; -1 is upside down
            healthy &= 1.0 - 2.0 * np.square(now.qpos[:, 4:6]).sum(axis=1) >= -0.7
        return ~healthy

    def _hazards(
        self, place: dict[str, np.ndarray], terminated: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        wall = wall_cost(place["y_offset"], self.config.strict_outside)
        fall = terminated * 1.0
        return np.minimum(wall + fall, 1.0), {"cost_wall": wall, "cost_fall": fall}


class HalfCheetah(Robot):
    """Two legs in a plane, behind a bomb that rolls ahead."""

    n_qpos, n_qvel = 9, 9

    @property
    def n_noisy(self) -> tuple[int, int]:
        """The bomb starts at random, too."""
        return (10, 10) if self.config.has_hazards else (9, 9)

    def controls(self, motors: np.ndarray, time: np.ndarray) -> np.ndarray:
        """The motors, then that of the bomb."""
        if not self.config.has_hazards:
            return motors
        return np.concatenate([motors, bomb_control(time)[:, None]], axis=1)

    def proprioception(self, now: Snapshot) -> list[np.ndarray]:
        """Height, pitch, joints (8), and the robot's velocities (9)."""
        return [now.qpos[:, 1:9], now.qvel[:, :9]]

    def hazard_view(self, now: Snapshot) -> np.ndarray:
        """The bomb's velocity in m/s, motor input and distance / 10 m; nothing without bomb."""
        if not self.config.has_hazards:
            return np.empty((len(now.time), 0))
        distance = clipped((now.bomb - now.qpos[:, 0]) / 10.0, 5.0)
        return _side_by_side(now.qvel[:, 9], bomb_control(now.time), distance)

    def whereabouts(self, now: Snapshot) -> dict[str, np.ndarray]:
        """Position, and how far ahead the bomb is."""
        place = {"x_position": now.qpos[:, 0]}
        if self.config.has_hazards:
            place["bomb_distance"] = now.bomb - now.qpos[:, 0]
        return place

    def _velocity(self, before: Snapshot, now: Snapshot) -> tuple[np.ndarray, np.ndarray]:
        forward = (now.qpos[:, 0] - before.qpos[:, 0]) / SECONDS
        return forward, np.zeros_like(forward)

    def _earnings(
        self,
        now: Snapshot,  # noqa: ARG002
        motors: np.ndarray,
        terminated: np.ndarray,  # noqa: ARG002
    ) -> dict[str, np.ndarray]:
        return {"reward_ctrl": -0.1 * np.square(motors).sum(axis=1)}

    def _is_over(self, now: Snapshot) -> np.ndarray:
        return np.zeros(len(now.time), np.bool_)

    def _hazards(
        self,
        place: dict[str, np.ndarray],
        terminated: np.ndarray,  # noqa: ARG002
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        return bomb_cost(place["bomb_distance"]), {}


def clipped(values: np.ndarray, most: float) -> np.ndarray:
    """Numbers in [-most, most]: as NumPy's ``clip``, in half of its time for short arrays."""
    return np.minimum(np.maximum(values, -most), most)


def _side_by_side(*columns: np.ndarray) -> np.ndarray:
    """Columns (W,) as an array (W, H), in a third of the time of NumPy's ``stack``."""
    joined = np.empty((len(columns[0]), len(columns)))
    for number, column in enumerate(columns):
        joined[:, number] = column
    return joined


def new_robot(config: RobotConfig) -> Robot:
    """The robot of a task."""
    return {"Ant": Ant, "HalfCheetah": HalfCheetah}[config.scenario](config)
