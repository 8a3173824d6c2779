"""The way to mpe2, which is imported here and only when a world of its own is needed."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sb3_e2c.envs._particle_config import ParticleConfig, ParticleTask

_SCALE = 350  # pixels of mpe2's picture for a radius of 1, however far it zooms


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
    """RGB image of a world as mpe2 draws it, with who is who, uint8, shape (height, width, 3).

    Landmarks that agents pass through are hollow: mpe2 gives some of them the color of agents.
    """
    image = Image.fromarray(np.ascontiguousarray(world.render()))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size=18)
    hollow = [each for each in world.world.landmarks if not each.collide]
    for entity in hollow:
        x, y = _pixel(world, entity)
        _disk(draw, x, y, 0.5 * entity.size * _SCALE, "white")
    for line, (label, entity) in enumerate(_legend(world.world, task).items()):
        y = 20 + 24 * line
        # mpe2 draws bodies in 200 times their color
        _disk(draw, 20, y, 8, tuple(int(200 * c) for c in entity.color))
        if entity in hollow:
            _disk(draw, 20, y, 4, "white")
        draw.text((36, y - 11), label, fill="black", font=font)
    return np.array(image)


def _legend(world: Any, task: ParticleTask) -> dict[str, Any]:
    """One entity of each kind, by what it is."""
    agents = {agent.name: agent for agent in world.agents}
    kinds = {"team": agents[task.team[0]], "adversary": agents[task.opponents[0]]}
    if not task.has_goal:
        return kinds | {"obstacle": world.landmarks[0]}
    goal = world.agents[0].goal_a
    other = next(each for each in world.landmarks if each is not goal)
    return kinds | {"the landmark that counts": goal, "another landmark": other}


def _pixel(world: Any, entity: Any) -> tuple[float, float]:
    """Where mpe2 draws an entity; its picture zooms so that everything is in it."""
    reach = max(np.abs(each.state.p_pos).max() for each in world.world.entities)
    x, y = entity.state.p_pos / reach * 0.9
    return world.width // 2 * (1 + x), world.height // 2 * (1 - y)


def _disk(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, fill: Any) -> None:
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=fill)
