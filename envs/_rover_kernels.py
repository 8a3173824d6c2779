"""The rules of the multi-rover domain (Sec. 5.1), compiled: one pass over all worlds per step.

``W`` worlds, ``N`` rovers, ``K`` POIs, ``Q`` sectors, ``D`` observation size. The order inside one
step: move, collision costs, visitors and relevance, captures, sensors, rewards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sb3_e2c.envs._rover_config import SENSOR_FLOOR

SENSOR_TYPES = ("closest", "density", "sum")
_EMPTY = -1.0
# numpy's error model: no check for a zero divisor at every division
_compiled = njit(cache=True, error_model="numpy")
_CLOSEST, _DENSITY = 0, 1  # indices into SENSOR_TYPES


class Rules(NamedTuple):
    """The part of a ``RoverConfig`` that the compiled code reads, as plain numbers."""

    dim: float
    max_step: float
    max_cycles: int
    coupling: int
    act_radius: float
    collision_radius: float
    sensor_radius: float
    n_sectors: int
    sensor_type: int
    log_scale: bool
    add_id: bool
    add_velocity: bool
    add_position: bool
    pay_at_capture: bool
    limit_terminates: bool
    early_stop: bool


class State(NamedTuple):
    """Everything that changes during an episode, except the random streams."""

    positions: np.ndarray  # (W, N, 2)
    displacements: np.ndarray  # (W, N, 2), last move after clamping
    pois: np.ndarray  # (W, K, 2)
    captured: np.ndarray  # (W, K) bool
    share: np.ndarray  # (W,) captured share of the total value
    clock: np.ndarray  # (W,) steps of the running episode
    team_cost: np.ndarray  # (W,) cost of the running episode, for the picture only
    colliding: np.ndarray  # (W, N) bool, after the last move


class Outcome(NamedTuple):
    """What one step reports."""

    observations: np.ndarray  # (W, N, D)
    sensors: np.ndarray  # (W, N, 2Q), unscaled
    rewards: np.ndarray  # (W, N)
    costs: np.ndarray  # (W, N)
    betas: np.ndarray  # (W, N)
    counts: np.ndarray  # (2, W, N): POIs captured so far, colliding pairs
    ended: np.ndarray  # (2, W) bool: terminated, truncated


@_compiled
def step_worlds(rules, values, state, actions, out):
    """Advance every world by one step; writes into the arrays of ``state`` and ``out``.

    Takes plain tuples and names their fields inside: recognizing the type of a named tuple at a
    call takes longer than stepping a world.

    :param rules: fields of :class:`Rules`
    :param values: values of the POIs, shape (K,)
    :param state: fields of :class:`State`
    :param actions: shape (W, N, 2)
    :param out: fields of :class:`Outcome`
    """
    _step_worlds(Rules(*rules), values, State(*state), actions, Outcome(*out))


@_compiled
def observe_worlds(rules, values, state, worlds, sensors, observations):
    """Fill raw sensors (R, N, 2Q) and observations (R, N, D) of the given worlds (R,)."""
    _observe_worlds(Rules(*rules), values, State(*state), worlds, sensors, observations)


@_compiled
def _step_worlds(rules, values, state, actions, out):
    for w in range(len(actions)):
        state.clock[w] += 1
        _move(rules, actions[w], state.positions[w], state.displacements[w])
        pairs = _collide(rules, state.positions[w], state.colliding[w], out.costs[w])
        state.team_cost[w] += out.costs[w].sum()
        before = state.share[w]
        _visit(rules, values, state.positions[w], state.pois[w], state.captured[w], out.betas[w])
        state.share[w] = _captured_share(values, state.captured[w])
        is_last = state.clock[w] >= rules.max_cycles
        is_done = rules.early_stop and state.captured[w].all()
        out.ended[0, w] = is_done or (is_last and rules.limit_terminates)
        out.ended[1, w] = is_last and not out.ended[0, w]
        if rules.pay_at_capture:
            out.rewards[w] = state.share[w] - before
        else:
            out.rewards[w] = state.share[w] if is_last or is_done else 0.0
        out.counts[0, w] = state.captured[w].sum()
        out.counts[1, w] = pairs
    worlds = np.arange(len(actions))
    _observe_worlds(rules, values, state, worlds, out.sensors, out.observations)


@_compiled
def _move(rules, actions, positions, displacements):
    """Clip the actions, move, clamp to the world."""
    for i in range(len(positions)):
        for axis in range(2):
            start = positions[i, axis]
            step = min(max(actions[i, axis], -1.0), 1.0) * rules.max_step
            positions[i, axis] = min(max(start + step, 0.0), rules.dim)
            displacements[i, axis] = positions[i, axis] - start


@_compiled
def _squared_distance(a, i, b, j):
    """Between row i of a and row j of b; a view of a row would cost more than the distance."""
    return (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2


@_compiled
def _collide(rules, positions, colliding, costs):
    """A rover's cost is 1 while any other one is strictly closer than the collision radius."""
    pairs = 0
    colliding[:] = False
    for i in range(len(positions)):
        for j in range(i):
            if _squared_distance(positions, i, positions, j) < rules.collision_radius**2:
                pairs += 1
                colliding[i] = True
                colliding[j] = True
    for i in range(len(positions)):
        costs[i] = 1.0 if colliding[i] else 0.0
    return pairs


@_compiled
def _visit(rules, values, positions, pois, captured, betas):
    """Relevance β of every rover, then the captures of this step.

    β is taken before a POI is marked, so the rovers that complete a capture still receive it.
    """
    betas[:] = 1.0
    for k in range(len(pois)):
        if captured[k]:
            continue
        visitors = 0
        for i in range(len(positions)):
            if _squared_distance(positions, i, pois, k) <= rules.act_radius**2:
                betas[i] *= values[k]
                visitors += 1
        captured[k] = visitors >= rules.coupling


@_compiled
def _captured_share(values, captured):
    total = 0.0
    taken = 0.0
    for k in range(len(values)):
        total += values[k]
        if captured[k]:
            taken += values[k]
    return taken / total


@_compiled
def _observe_worlds(rules, values, state, worlds, sensors, observations):
    hits = np.zeros(sensors.shape[1:], np.int64)
    for row in range(len(worlds)):
        w = worlds[row]
        _sense(
            rules, values, state.positions[w], state.pois[w], state.captured[w], sensors[row], hits
        )
        _assemble(
            rules,
            values,
            state.positions[w],
            state.displacements[w],
            sensors[row],
            observations[row],
        )


@_compiled
def _sense(rules, values, positions, pois, captured, sensors, hits):
    """1/d² of the other rovers, then V/d² of the open POIs, collected by sector."""
    sensors[:] = _EMPTY
    hits[:] = 0
    n = len(positions)
    for i in range(n):
        for target in range(n + len(pois)):
            is_rover = target < n
            if target == i or (not is_rover and captured[target - n]):
                continue
            x, y = _row(positions, target) if is_rover else _row(pois, target - n)
            dx = x - positions[i, 0]
            dy = y - positions[i, 1]
            squared = dx * dx + dy * dy
            if squared <= rules.sensor_radius**2:
                signal = (1.0 if is_rover else values[target - n]) / max(squared, SENSOR_FLOOR**2)
                s = _sector(dx, dy, rules.n_sectors) + (0 if is_rover else rules.n_sectors)
                sensors[i, s] = _combine(rules.sensor_type, sensors[i, s], signal)
                hits[i, s] += 1
    if rules.sensor_type == _DENSITY:
        _divide(sensors, hits)


@_compiled
def _row(points, i):
    return points[i, 0], points[i, 1]


@_compiled
def _combine(sensor_type, so_far, signal):
    """Largest signal of a sector, or the sum of them; ``so_far`` is -1 while it is empty."""
    return max(so_far, signal) if sensor_type == _CLOSEST else max(so_far, 0.0) + signal


@_compiled
def _divide(sensors, hits):
    for i in range(len(sensors)):
        for s in range(sensors.shape[1]):
            sensors[i, s] /= max(hits[i, s], 1)


@_compiled
def _sector(dx, dy, n_sectors):
    """Sector of the angle atan2(dx, dy), counted clockwise from the y axis."""
    if n_sectors == 4:  # the same quarters, borders included, without arc tangent or branches
        left = (dx < 0.0) | ((dx == 0.0) & (dy < 0.0))
        return left * (2 + (dy >= 0.0)) + (dx > 0.0) * (dy <= 0.0)
    turn = math.atan2(dx, dy) / (2.0 * math.pi)
    return min(int((turn % 1.0) * n_sectors), n_sectors - 1)


@_compiled
def _assemble(rules, values, positions, displacements, sensors, observations):
    """Observations of one world: sensors, then identity, displacement and position if wanted."""
    _scale(rules, values.max(), sensors, observations)
    for i in range(len(positions)):
        end = sensors.shape[1]
        if rules.add_id:
            for j in range(len(positions)):
                observations[i, end + j] = 1.0 if i == j else 0.0
            end += len(positions)
        if rules.add_velocity:
            observations[i, end] = displacements[i, 0]
            observations[i, end + 1] = displacements[i, 1]
            end += 2
        if rules.add_position:
            observations[i, end] = positions[i, 0] / rules.dim
            observations[i, end + 1] = positions[i, 1] / rules.dim


@_compiled
def _scale(rules, largest_value, sensors, observations):
    """Copy the sensors, on request as log(x R²/V_max) / log(R²/d_min²), clipped to [0, 1]."""
    radius_squared = rules.sensor_radius**2
    span = math.log(radius_squared / SENSOR_FLOOR**2)
    for i in range(len(sensors)):
        for s in range(sensors.shape[1]):
            signal = sensors[i, s]
            if rules.log_scale and signal > 0.0:
                largest = 1.0 if s < rules.n_sectors else largest_value
                scaled = math.log(signal * radius_squared / largest) / span
                signal = min(max(scaled, 0.0), 1.0)
            observations[i, s] = signal
