"""Pictures of a multi-rover world, drawn with Pillow at twice the size and reduced."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_e2c.envs._rover_config import RoverConfig
from sb3_e2c.envs._rover_kernels import State

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

Color = tuple[int, ...]

_OVERSAMPLING = 2
_MARGIN, _HEADER, _FIELD = 16, 48, 576  # picture: 608 x 656, multiples of 16 for video encoders

_PAPER, _GROUND, _GRID, _INK = (255, 255, 255), (248, 249, 251), (233, 236, 241), (38, 43, 51)
_OPEN, _CAPTURED, _COLLISION = (217, 57, 57), (38, 153, 83), (235, 20, 20)
_ROVERS: tuple[Color, ...] = (
    (31, 107, 196),
    (240, 140, 25),
    (126, 82, 190),
    (20, 160, 175),
    (196, 68, 148),
    (121, 85, 61),
    (64, 72, 88),
    (176, 156, 20),
    (95, 140, 230),
    (150, 40, 90),
)


def draw_world(config: RoverConfig, state: State) -> np.ndarray:
    """Draw one world.

    :param config: parameters of the world
    :param state: its state, the arrays without the leading axis of worlds
    :return: RGB image, uint8, shape (656, 608, 3)
    """
    try:
        from PIL import Image, ImageDraw
    except ImportError as error:
        raise ImportError(
            "rendering needs Pillow, which is not installed: pip install sb3-e2c[envs]"
        ) from error

    field = Image.new("RGB", (_px(_FIELD), _px(_FIELD)), _GROUND)
    pen = _Pen(ImageDraw.Draw(field, "RGBA"), _px(_FIELD) / config.dim, _px(_FIELD))
    _draw_grid(pen, config)
    _draw_sensors(pen, config, state)
    _draw_pois(pen, config, state)
    _draw_rovers(pen, state)

    size = (_px(_FIELD + 2 * _MARGIN), _px(_HEADER + _FIELD + 2 * _MARGIN))
    picture = Image.new("RGB", size, _PAPER)
    picture.paste(field, (_px(_MARGIN), _px(_HEADER + _MARGIN)))
    draw = ImageDraw.Draw(picture)
    _draw_frame(draw, bool(state.colliding.any()))
    _draw_header(draw, config, state)
    return np.asarray(picture.reduce(_OVERSAMPLING))


def _px(length: float) -> int:
    """Pixels of the large picture for pixels of the final one."""
    return round(length * _OVERSAMPLING)


def _font(size: float) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(_px(size))


class _Pen:
    """Draws shapes given in world units, with y pointing up."""

    def __init__(self, draw: ImageDraw, scale: float, height: int) -> None:
        self.draw = draw
        self.scale = scale
        self.height = height

    def at(self, position: np.ndarray) -> tuple[float, float]:
        """Pixel of a world position, shape (2,)."""
        return float(position[0]) * self.scale, self.height - float(position[1]) * self.scale

    def box(self, position: np.ndarray, radius: float) -> tuple[float, float, float, float]:
        """Bounding box in pixels of a circle in world units."""
        x, y = self.at(position)
        r = radius * self.scale
        return x - r, y - r, x + r, y + r

    def text(self, position: np.ndarray, text: str, size: float, color: Color) -> None:
        """Text centered at a world position."""
        self.draw.text(self.at(position), text, fill=color, font=_font(size), anchor="mm")


def _draw_grid(pen: _Pen, config: RoverConfig) -> None:
    for line in np.arange(0.0, config.dim + 1e-9, max(1.0, config.dim // 10)):
        offset = line * pen.scale
        pen.draw.line((offset, 0, offset, pen.height), fill=_GRID, width=_px(0.5))
        pen.draw.line((0, pen.height - offset, pen.height, pen.height - offset), fill=_GRID)


def _draw_sensors(pen: _Pen, config: RoverConfig, state: State) -> None:
    """Faint discs; none if a sensor covers the whole world."""
    if config.sensor_radius >= config.dim:
        return
    for i, position in enumerate(state.positions):
        disc = pen.box(position, config.sensor_radius)
        pen.draw.ellipse(disc, fill=(*_color(i), 4), outline=(*_color(i), 35), width=_px(0.75))


def _color(rover: int) -> Color:
    return _ROVERS[rover % len(_ROVERS)]


def _draw_pois(pen: _Pen, config: RoverConfig, state: State) -> None:
    """Activation circle, one arc per rover needed (filled by visitors), and "visitors/needed"."""
    half = 14.0 * _OVERSAMPLING / pen.scale
    for poi, value, captured in zip(state.pois, config.poi_values, state.captured, strict=True):
        color = _CAPTURED if captured else _OPEN
        visitors = int((np.hypot(*(state.positions - poi).T) <= config.act_radius).sum())
        filled = config.coupling if captured else min(visitors, config.coupling)
        ring = pen.box(poi, config.act_radius)
        pen.draw.ellipse(ring, fill=(*color, 30))
        sweep = 360.0 / config.coupling
        for part in range(config.coupling):
            start = -90.0 + part * sweep + 4.0
            alpha, width = (255, 4.0) if part < filled else (90, 2.0)
            pen.draw.arc(ring, start, start + sweep - 8.0, (*color, alpha), _px(width))
        pen.draw.rounded_rectangle(pen.box(poi, half), _px(4), fill=color)
        pen.text(poi, f"{filled}/{config.coupling}", 13, _PAPER)
        if len(set(config.poi_values)) > 1:
            pen.text(poi - [0.0, 2.0 * half], f"value {value:g}", 12, color)


def _draw_rovers(pen: _Pen, state: State) -> None:
    """Numbered discs with a tail over the last move; a red ring marks a collision."""
    body = 8.5 * _OVERSAMPLING / pen.scale
    for i, position in enumerate(state.positions):
        tail = (*pen.at(position - 1.5 * state.displacements[i]), *pen.at(position))
        pen.draw.line(tail, fill=(*_color(i), 130), width=_px(4))
    for position in state.positions[state.colliding]:
        pen.draw.ellipse(pen.box(position, 2.6 * body), fill=(*_COLLISION, 70))
    for i, position in enumerate(state.positions):
        outline = _COLLISION if state.colliding[i] else _PAPER
        edge = body + (3.5 if state.colliding[i] else 1.5) * _OVERSAMPLING / pen.scale
        pen.draw.ellipse(pen.box(position, edge), fill=outline)
        pen.draw.ellipse(pen.box(position, body), fill=_color(i))
        pen.text(position, str(i), 11, _PAPER)


def _draw_frame(draw: ImageDraw, is_collision: bool) -> None:
    left, top, size = _px(_MARGIN), _px(_HEADER + _MARGIN), _px(_FIELD)
    width = _px(4 if is_collision else 1)
    box = (left - width, top - width, left + size + width - 1, top + size + width - 1)
    draw.rectangle(box, outline=_COLLISION if is_collision else (190, 195, 203), width=width)


def _draw_header(draw: ImageDraw, config: RoverConfig, state: State) -> None:
    """Step, captured share and cost so far; the number of rovers in collision on the right."""
    left, middle, right = _px(_MARGIN), _px(_MARGIN / 2 + _HEADER / 2 + 4), _px(_MARGIN + _FIELD)
    status = (
        f"step {int(state.clock)}/{config.max_cycles}    captured {float(state.share):.0%}"
        f"    team cost {float(state.team_cost):.0f}"
    )
    draw.text((left, middle), status, fill=_INK, font=_font(19), anchor="lm")
    colliding = int(state.colliding.sum())
    if colliding:
        text = f"collision of {colliding} rovers"
        draw.text((right, middle), text, fill=_COLLISION, font=_font(19), anchor="rm")
