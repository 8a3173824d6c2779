"""Where walls and bombs are, how bombs move, and what they cost: functions of numbers only.

All of it follows the public repository Safe-Multi-Agent-MuJoCo.
"""

from __future__ import annotations

import numpy as np

# The corridor of the Ant: three pieces of 40 m, turned by ±30 degrees, then straight on.
SLOPE = float(np.tan(np.pi / 6))
WALL_OFFSET = 5.0  # m along y from the center line to a wall
WALL_MARGIN = 1.8  # m along y, closer costs

# The bomb of the HalfCheetah
BOMB_START = 10.0  # m, center of the bomb at joint position 0
BOMB_MARGIN = 9.0  # m along x, closer costs


def corridor_offset(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance along y from the center line of the corridor, in m, positive to the left.

    The original leaves out the points x = 20, 60 and 100 themselves by an accident of strict
    inequalities; the line is continuous there, so that they belong to the next piece.

    :param x: positions in m, shape (...,)
    :param y: positions in m, shape (...,)
    """
    beyond = np.where(x < 100.0, x - 80.0, 20.0)
    along = np.where(x < 20.0, x, np.where(x < 60.0, 40.0 - x, beyond))
    return y - SLOPE * along


def wall_cost(offset: np.ndarray, strict_outside: bool = False) -> np.ndarray:
    """1.0 close to a wall, else 0.0.

    :param offset: of :func:`corridor_offset`, shape (...,)
    :param strict_outside: charge everything beyond the margin, also what has crossed a wall;
        without it, as in the original, who is far outside is free of cost
    """
    to_wall = WALL_OFFSET - np.abs(offset)
    return (to_wall < WALL_MARGIN if strict_outside else np.abs(to_wall) < WALL_MARGIN) * 1.0


def bomb_control(time: np.ndarray) -> np.ndarray:
    """Input of the bomb's motor, whose gear is 120: a force of 120 u, in N.

    :param time: seconds since the start of the episode, shape (...,)
    """
    return 0.02 * np.sin(time / 3.0) ** 2 - 0.004


def bomb_cost(distance: np.ndarray) -> np.ndarray:
    """1.0 within the margin on either side of the bomb, else 0.0.

    :param distance: x of the bomb minus x of the robot, in m, shape (...,)
    """
    return (np.abs(distance) < BOMB_MARGIN) * 1.0
