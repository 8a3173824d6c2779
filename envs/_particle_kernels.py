"""The particle tasks, compiled: one pass over all worlds for each part of a step, equal to mpe2's.

``W`` worlds, ``A`` agents, ``E`` entities (agents, then landmarks), ``K`` landmarks. The order
inside one step is mpe2's: contact forces, positions, velocities, then rewards, costs and
observations. What differs between the tasks stands in tables of :class:`Rules`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

_DT = 0.1
_DAMPING = 0.25
_CONTACT_FORCE = 100.0
_CONTACT_MARGIN = 0.001
_DECEPTION, _KEEP_AWAY = 0, 1  # index in TASKS; 2 is predator prey
# numpy's error model: no check for a zero divisor at every division
_compiled = njit(cache=True, error_model="numpy")


class Rules(NamedTuple):
    """What the compiled code knows of a task and its parameters.

    A pair of entities has an agent first, and beside it the distance at which the two touch.
    """

    task: int  # index in TASKS
    max_cycles: int
    is_team: np.ndarray  # (A,) bool
    max_speeds: np.ndarray  # (A,)
    pushing: np.ndarray  # (P, 2) pairs that push each other, every pair once
    pushing_at: np.ndarray  # (P,)
    counted: np.ndarray  # (C, 2) contact with the second costs the first
    counted_at: np.ndarray  # (C,)
    catching: np.ndarray  # (F, 2) of an opponent and an agent of the team
    catching_at: np.ndarray  # (F,)
    goal_colors: np.ndarray  # (K, 3) color of the team for every goal
    numbers: np.ndarray  # of a world, see _particle_views; here without those that change
    team: np.ndarray  # (2, team · D) which numbers are observed, minus which
    opponents: np.ndarray  # (2, opponents · D)


class State(NamedTuple):
    """Everything that changes during an episode, except the random streams."""

    positions: np.ndarray  # (W, E, 2)
    velocities: np.ndarray  # (W, A, 2)
    goals: np.ndarray  # (W,) landmark, 0 where there is none
    clock: np.ndarray  # (W,) steps of the running episode
    starts: np.ndarray  # (W, E, 2) where the episode began, for the scale of the picture only


class Outcome(NamedTuple):
    """What one step reports."""

    team: np.ndarray  # (W, team · D) observations
    opponents: np.ndarray  # (W, opponents · D) observations
    rewards: np.ndarray  # (W, A)
    costs: np.ndarray  # (W, A)
    truncated: np.ndarray  # (W,) bool


# Bodies further apart push each other with less than 1e-53, which no observation can show; down
# to -746, where mpe2's force vanishes, the processor would take long over its tiny numbers.
_NO_FORCE = -120.0
_EXPONENTIAL = -40.0  # log(1 + exp(x)) of less is exp(x), to the last bit


@_compiled
def push_by_actions(actions, accelerations, controls):
    """Write the forces of discrete actions.

    :param actions: 0, ..., 4: nothing, left, right, down, up, shape (W, A)
    :param accelerations: Shape (A,)
    :param controls: Shape (W, A, 2), filled with zeros
    :return: Number of the first agent, counted over all worlds, with another action; else -1
    """
    for w in range(actions.shape[0]):
        for i in range(actions.shape[1]):
            action = actions[w, i]
            if action < 0 or action > 4:
                return w * actions.shape[1] + i
            if action > 0:
                sign = -1.0 if action % 2 == 1 else 1.0
                controls[w, i, (action - 1) // 2] = sign * accelerations[i]
    return -1


@_compiled
def step_worlds(rules, state, controls, out):
    """Advance every world by one step; writes into the arrays of ``state`` and ``out``.

    Takes plain tuples and names their fields inside: recognizing the type of a named tuple at a
    call takes longer than stepping a world.

    :param rules: fields of :class:`Rules`
    :param state: fields of :class:`State`
    :param controls: forces that the agents apply, shape (W, A, 2); changed
    :param out: fields of :class:`Outcome`
    """
    _step_worlds(Rules(*rules), State(*state), controls, Outcome(*out))


@_compiled
def observe_worlds(rules, state, worlds, team, opponents):
    """Fill the observations (R, agents of the group · D) of the given worlds (R,)."""
    _observe_worlds(Rules(*rules), State(*state), worlds, team, opponents)


@_compiled
def _step_worlds(rules, state, controls, out):
    positions = state.positions
    _push(rules.pushing, rules.pushing_at, positions, controls)
    _move(rules.max_speeds, positions, state.velocities, controls)
    if rules.task == _DECEPTION or rules.task == _KEEP_AWAY:
        _reward_goal(rules.task, rules.is_team, positions, state.goals, out.rewards)
    else:
        _reward_hunt(rules.is_team, rules.catching, rules.catching_at, positions, out.rewards)
    _cost(rules.counted, rules.counted_at, positions, out.costs)
    for w in range(len(controls)):
        state.clock[w] += 1
        out.truncated[w] = state.clock[w] >= rules.max_cycles
    _observe_worlds(rules, state, np.arange(len(controls)), out.team, out.opponents)


@_compiled
def _distance(positions, w, i, j):
    dx = positions[w, i, 0] - positions[w, j, 0]
    dy = positions[w, i, 1] - positions[w, j, 1]
    return math.sqrt(dx * dx + dy * dy)


@_compiled
def _softened(depth):
    """log(1 + exp(depth)), without overflow."""
    if depth < _EXPONENTIAL:
        return math.exp(depth)
    return max(depth, 0.0) + math.log1p(math.exp(-abs(depth)))


@_compiled
def _push(pairs, touching, positions, forces):
    """Add the soft contact forces between bodies that collide."""
    n_agents = forces.shape[1]
    for w in range(len(forces)):
        for p in range(len(pairs)):
            i, j = pairs[p]
            distance = _distance(positions, w, i, j)
            depth = -(distance - touching[p]) / _CONTACT_MARGIN
            if depth < _NO_FORCE:
                continue
            size = _softened(depth) * _CONTACT_MARGIN
            for axis in range(2):
                way = positions[w, i, axis] - positions[w, j, axis]
                force = _CONTACT_FORCE * way / distance * size
                forces[w, i, axis] += force
                if j < n_agents:  # landmarks do not move
                    forces[w, j, axis] -= force


@_compiled
def _move(max_speeds, positions, velocities, forces):
    """Positions by the old velocities, then velocities; their norm is clipped."""
    for w in range(len(forces)):
        for i in range(len(max_speeds)):
            for axis in range(2):
                old = velocities[w, i, axis]
                positions[w, i, axis] += old * _DT
                velocities[w, i, axis] = old * (1.0 - _DAMPING) + forces[w, i, axis] * _DT
            speed = math.sqrt(velocities[w, i, 0] ** 2 + velocities[w, i, 1] ** 2)
            if speed > max_speeds[i]:
                for axis in range(2):
                    velocities[w, i, axis] = velocities[w, i, axis] / speed * max_speeds[i]


@_compiled
def _reward_goal(task, is_team, positions, goals, rewards):
    """Deception: closest of the team against the adversary. Keep away: everyone for oneself."""
    n_agents = len(is_team)
    distances = np.empty(n_agents)
    for w in range(len(goals)):
        closest, others = np.inf, 0.0
        for i in range(n_agents):
            distances[i] = _distance(positions, w, i, n_agents + goals[w])
            if is_team[i]:
                closest = min(closest, distances[i])
            else:
                others += distances[i]
        for i in range(n_agents):
            rewards[w, i] = -distances[i]
            if task == _DECEPTION and is_team[i]:
                rewards[w, i] = -closest + others
            elif task == _KEEP_AWAY and not is_team[i]:
                rewards[w, i] = closest - distances[i]


@_compiled
def _reward_hunt(is_team, pairs, touching, positions, rewards):
    """Predators share 10 per touch of the prey; the prey loses it, and more when it is outside."""
    n_agents = len(is_team)
    caught = np.empty(n_agents)
    for w in range(len(rewards)):
        caught[:] = 0.0
        for p in range(len(pairs)):
            i, j = pairs[p]
            caught[i] += _distance(positions, w, i, j) < touching[p]
        for i in range(n_agents):
            if is_team[i]:
                rewards[w, i] = 10.0 * caught.sum()
            else:
                outside = _outside(positions[w, i, 0]) + _outside(positions[w, i, 1])
                rewards[w, i] = -10.0 * caught[i] - outside


@_compiled
def _outside(coordinate):
    x = abs(coordinate)
    if x < 0.9:
        return 0.0
    return (x - 0.9) * 10.0 if x < 1.0 else min(math.exp(2.0 * x - 2.0), 10.0)


@_compiled
def _cost(pairs, touching, positions, costs):
    costs[:] = 0.0
    for w in range(len(costs)):
        for p in range(len(pairs)):
            i, j = pairs[p]
            if _distance(positions, w, i, j) < touching[p]:
                costs[w, i] = 1.0


@_compiled
def _observe_worlds(rules, state, worlds, team, opponents):
    numbers = rules.numbers.copy()
    for row in range(len(worlds)):
        _read(
            state.positions, state.velocities, state.goals, rules.goal_colors, worlds[row], numbers
        )
        _observe(numbers, rules.team, team, row)
        _observe(numbers, rules.opponents, opponents, row)


@_compiled
def _read(positions, velocities, goals, goal_colors, w, numbers):
    """The numbers of a world that change, in the order of ``_particle_views``."""
    n_agents, n_entities = velocities.shape[1], positions.shape[1]
    goal, end = goals[w], 2 * (n_agents + n_entities)
    for axis in range(2):
        for j in range(n_entities):
            numbers[2 * j + axis] = positions[w, j, axis]
        for i in range(n_agents):
            numbers[2 * (n_entities + i) + axis] = velocities[w, i, axis]
        numbers[end + axis] = positions[w, n_agents + goal, axis]
    for channel in range(3):
        numbers[end + 2 + channel] = goal_colors[goal, channel]


@_compiled
def _observe(numbers, terms, out, row):
    for k in range(terms.shape[1]):
        out[row, k] = numbers[terms[0, k]] - numbers[terms[1, k]]
