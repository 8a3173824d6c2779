"""What a multi-rover world is made of: its numbers, their checks, and the placement at a start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import cos, hypot, isfinite, pi, sin, sqrt
from numbers import Integral, Real
from typing import Any

import numpy as np

SENSOR_FLOOR = 0.5  # sensors do not resolve distances below this one, so that 1/d² stays bounded
_MAX_DRAWS = 10_000

_CHOICES = {
    "poi_placement": ("scattered", "rings"),
    "sensor_type": ("closest", "density", "sum"),
    "sensor_scale": ("linear", "log"),
    "reward_at": ("end", "capture"),
    "time_limit": ("truncate", "terminate"),
}


@dataclass(frozen=True)
class RoverConfig:
    """All parameters of a multi-rover world; the defaults are the preset ``e2c``.

    What each parameter does stands in the docstring of :class:`multi_rover_v0.MultiRoverEnv`.
    """

    n_rovers: int = 6
    coupling: int = 2
    dim: float = 20.0
    poi_values: tuple[float, ...] = (5.0, 5.0, 5.0, 5.0)
    poi_placement: str = "scattered"
    poi_distance: float = 4.0
    max_step: float = 1.0
    max_cycles: int = 80
    act_radius: float = 2.0
    collision_radius: float = 0.5
    sensor_radius: float = 10.0
    n_sectors: int = 4
    sensor_type: str = "closest"
    sensor_scale: str = "linear"
    add_id: bool = False
    add_velocity: bool = False
    add_position: bool = False
    add_critic_state: bool = False
    reward_at: str = "end"
    time_limit: str = "truncate"
    early_stop: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "poi_values", _poi_values(self.poi_values))
        for field in fields(self):
            _check_type(field.name, str(field.type), getattr(self, field.name))
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected one of {allowed}")
        self._check_consistency()
        place_pois(self, np.random.default_rng(0))

    def _check_consistency(self) -> None:
        if self.coupling > self.n_rovers:
            raise ValueError(
                f"coupling is {self.coupling} with {self.n_rovers} rovers, so no POI could ever be "
                "captured; use a coupling of at most n_rovers"
            )
        if self.n_rovers > len(start_cells(self)):
            raise ValueError(
                f"n_rovers is {self.n_rovers}, but the start square of a world with dim={self.dim} "
                f"has {len(start_cells(self))} cells; use fewer rovers or a larger dim"
            )
        if self.poi_placement == "rings" and len(self.poi_values) % 2:
            raise ValueError(
                f"poi_placement='rings' puts half of the POIs on each of two rings, but poi_values "
                f"has {len(self.poi_values)} values; give an even number"
            )
        if self.sensor_scale == "log" and self.sensor_radius <= SENSOR_FLOOR:
            raise ValueError(
                f"sensor_scale='log' needs a sensor_radius above {SENSOR_FLOOR} (the near clipping "
                f"of the sensors), found {self.sensor_radius}"
            )

    @property
    def start_half_width(self) -> int:
        """Half width of the square of start cells (the rule of MERL and NS-MERL: 3 for dim 20)."""
        return int(self.dim / (2 * sqrt(10)))

    @property
    def center(self) -> float:
        """Both coordinates of the middle of the start cells, on the integer grid."""
        return float(int(self.dim) // 2)


def _poi_values(values: Any) -> tuple[float, ...]:
    """Any sequence of numbers (a list from YAML, say) as a tuple of floats."""
    is_numbers = isinstance(values, Sequence | np.ndarray) and all(_is_real(v) for v in values)
    if not is_numbers or len(values) == 0 or min(values) <= 0:
        raise ValueError(
            f"poi_values is {values!r}; expected at least one positive number, one for each POI"
        )
    return tuple(float(value) for value in values)


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def _check_type(name: str, annotation: str, value: Any) -> None:
    """Compare a parameter with its annotation; numbers must also be positive."""
    if annotation == "bool" and not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {value!r}; expected True or False")
    if annotation == "int" and (
        not isinstance(value, Integral) or isinstance(value, bool) or value < 1
    ):
        raise ValueError(f"{name} is {value!r}; expected an integer of at least 1")
    if annotation == "float" and (not _is_real(value) or value <= 0):
        raise ValueError(f"{name} is {value!r}; expected a finite number above 0")


def start_cells(config: RoverConfig) -> np.ndarray:
    """Integer cells of the central square in which rovers start, shape (cells, 2)."""
    half, center = config.start_half_width, config.center
    axis = np.arange(center - half, center + half + 1)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def place_rovers(config: RoverConfig, rng: np.random.Generator) -> np.ndarray:
    """Different start cells for all rovers, so that no episode begins with a collision.

    :return: positions, shape (N, 2)
    """
    cells = start_cells(config)
    return cells[rng.permutation(len(cells))[: config.n_rovers]]


def place_pois(config: RoverConfig, rng: np.random.Generator) -> np.ndarray:
    """Random POI positions of a new episode.

    :return: positions, shape (K, 2)
    """
    if config.poi_placement == "rings":
        return _on_rings(config, rng)
    return _scattered(config, rng)


def _scattered(config: RoverConfig, rng: np.random.Generator) -> np.ndarray:
    """Uniform outside the central square and at least ``poi_distance`` apart, by rejection."""
    placed: list[list[float]] = []
    for _ in range(_MAX_DRAWS // 16):
        for x, y in rng.uniform(0.0, config.dim, (16, 2)).tolist():
            if _has_room(config, x, y, placed):
                placed.append([x, y])
            if len(placed) == len(config.poi_values):
                return np.array(placed)
    raise ValueError(
        f"found room for {len(placed)} of {len(config.poi_values)} POIs with dim={config.dim} and "
        f"poi_distance={config.poi_distance}; use fewer POIs, a larger dim or less distance"
    )


def _has_room(config: RoverConfig, x: float, y: float, placed: list[list[float]]) -> bool:
    from_center = max(abs(x - config.center), abs(y - config.center))
    return from_center > config.start_half_width + 2 and all(
        hypot(x - other_x, y - other_y) >= config.poi_distance for other_x, other_y in placed
    )


def _on_rings(config: RoverConfig, rng: np.random.Generator) -> np.ndarray:
    """First half of the POIs on the ring of radius dim/4, second half on dim/2, random phases."""
    per_ring = len(config.poi_values) // 2
    middle = config.dim / 2
    positions = [
        (middle + radius * cos(angle), middle + radius * sin(angle))
        for radius, phase in zip((config.dim / 4, config.dim / 2), rng.random(2), strict=True)
        for angle in (2 * pi * (phase + k / per_ring) for k in range(per_ring))
    ]
    return np.clip(np.array(positions), 0.0, config.dim)
