"""The way to mpe2, which is imported here and only when a world of its own is needed."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sb3_e2c.envs._particle_config import ParticleConfig, ParticleTask


class _Replay:
    """Stands in for the random generator of one mpe2 reset and gives a known start."""

    def __init__(self, goal: int, positions: np.ndarray) -> None:
        self.goal = goal
        self.positions = iter(positions)

    def integers(self, high: int) -> int:
        assert self.goal < high
        return self.goal

    def uniform(self, *_: float) -> np.ndarray:
        return next(self.positions).copy()


def new_world(config: ParticleConfig, render_mode: str | None) -> Any:
    """Make mpe2's environment of a task (its ``raw_env``, without wrappers)."""
    # pygame greets on stdout, where programs write results that others read.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    module, parameters = config.task.mpe2
    try:
        raw_env = import_module(module).raw_env
    except ImportError as error:
        raise ImportError(
            f"{config.task.name} needs mpe2 for single worlds and pictures; install it with "
            "pip install sb3-e2c[envs]"
        ) from error
    return raw_env(
        max_cycles=config.max_cycles,
        continuous_actions=config.continuous_actions,
        render_mode=render_mode,
        **parameters,
    )


def restart(world: Any, goal: int, positions: np.ndarray) -> None:
    """Reset a world to a known start without touching its random stream.

    :param positions: of all entities, shape (entities, 2)
    """
    rng = world.np_random
    world.np_random = _Replay(goal, positions)
    try:
        world.reset()
    finally:
        world.np_random = rng


def picture(world: Any, task: ParticleTask) -> np.ndarray:
    """RGB image of a world as mpe2 draws it, with who is who, uint8, shape (height, width, 3)."""
    image = Image.fromarray(np.ascontiguousarray(world.render()))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size=18)
    colors = {entity.name: entity.color for entity in world.world.entities}
    for line, (label, name) in enumerate(
        (("team", task.team[0]), ("adversary", task.opponents[0]))
    ):
        y = 12 + 24 * line
        # mpe2 draws bodies in 200 times their color
        draw.ellipse((12, y, 28, y + 16), fill=tuple(int(200 * c) for c in colors[name]))
        draw.text((36, y - 3), label, fill="black", font=font)
    return np.array(image)
