"""How episodes of a robot begin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_e2c.envs._mujoco_import import mujoco
from sb3_e2c.envs._mujoco_robots import Robot

NOISE = 0.1
Start = tuple[np.ndarray, np.ndarray]  # qpos (nq,), qvel (nv,)


def draw_start(robot: Robot, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
    """Uniform noise on positions, normal noise on velocities; free walls stand where they are.

    One seed gives the start that gymnasium's robot gets from it.

    :param robot: the robot
    :param model: its model
    :param rng: random stream of the world
    """
    n_qpos, n_qvel = robot.n_noisy
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    qpos[:n_qpos] += rng.uniform(-NOISE, NOISE, n_qpos)
    qvel[:n_qvel] += NOISE * rng.standard_normal(n_qvel)
    return qpos, qvel


def place(starts: list[Start], options: Mapping[str, Any] | None) -> list[Start]:
    """Starts with positions or velocities chosen by hand.

    :param starts: of R worlds
    :param options: "qpos" (nq,) or (R, nq), "qvel" (nv,) or (R, nv); other keys are ignored
    """
    if not starts:
        return starts
    columns = [np.stack(column) for column in zip(*starts, strict=True)]
    for number, key in enumerate(("qpos", "qvel")):
        if options and options.get(key) is not None:
            columns[number] = _placed(key, options[key], columns[number].shape)
    return list(zip(*columns, strict=True))


def _placed(key: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in (shape, shape[1:]):
        raise ValueError(
            f"options[{key!r}] has shape {array.shape}; expected {shape[1:]}, or {shape} to place "
            "every world differently"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"options[{key!r}] is {array.tolist()}; expected finite numbers")
    return np.broadcast_to(array, shape)
