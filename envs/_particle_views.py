"""Observations of the particle tasks: each entry is one number of a world minus another.

The numbers of a world stand in one row: positions (E, 2), velocities (A, 2), position of the goal
(2,), color of the goal (3,), then what never changes, zero and the colors of the landmarks (K, 3).
"""

from __future__ import annotations

import math

import numpy as np

from sb3_e2c.envs._particle_config import ParticleTask

Places = dict[str, np.ndarray]


def places(task: ParticleTask) -> Places:
    """Where the numbers of a world stand in its row, for each quantity in the quantity's shape."""
    n_agents, n_landmarks = len(task.agents), task.n_landmarks
    shapes = {
        "positions": (n_agents + n_landmarks, 2),
        "velocities": (n_agents, 2),
        "goal": (2,),
        "goal_color": (3,),
        "zero": (1,),
        "colors": (n_landmarks, 3),
    }
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    return {
        name: np.arange(end - math.prod(shape), end).reshape(shape)
        for (name, shape), end in zip(shapes.items(), ends, strict=True)
    }


def colors(n_landmarks: int, gray: float, more: float) -> np.ndarray:
    """Colors in which channel 1 stands out for the first landmark, 2 for the second, (K, 3)."""
    return gray + more * np.eye(n_landmarks, 3, k=1)


def constant_numbers(task: ParticleTask) -> np.ndarray:
    """A row of numbers of which those that never change are set."""
    where = places(task)
    numbers = np.zeros(where["colors"].max() + 1)
    numbers[where["colors"]] = colors(task.n_landmarks, 0.1, 0.8)
    return numbers


def terms(task: ParticleTask, group: str) -> np.ndarray:
    """Which number and minus which each entry of a group's observations is.

    :param task: Says what the group sees
    :param group: "team" or "opponents"
    :return: Shape (2, n · D), agent after agent
    """
    agents = range(len(task.agents))[task.members[group]]
    table = np.concatenate([_terms_of_agent(task, group, i) for i in agents], axis=1)
    return table.astype(np.uintp)  # compiled code asks of signed indices whether they are negative


def _terms_of_agent(task: ParticleTask, group: str, i: int) -> np.ndarray:
    where, n_agents = places(task), len(task.agents)
    view = task.team_view if group == "team" else task.opponent_view
    zero, own = where["zero"], where["positions"][i]
    others = [j for j in range(n_agents) if j != i]
    pairs = [
        (view.velocity, where["velocities"][i], zero),
        (view.position, own, zero),
        (view.goal, where["goal"], own),
        (view.colors, where["goal_color"], zero),
        (True, where["positions"][n_agents:], own),
        (view.colors, where["colors"], zero),
        (True, where["positions"][others], own),
        (view.prey_velocity, where["velocities"][task.members["opponents"]], zero),
    ]
    seen = [np.stack(np.broadcast_arrays(*pair)) for present, *pair in pairs if present]
    return np.concatenate([part.reshape(2, -1) for part in seen], axis=1)
