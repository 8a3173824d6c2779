"""The particle tasks, compiled: one pass over all worlds per step, equal to mpe2's.

``W`` worlds, ``A`` agents, ``E`` entities (agents, then landmarks). The order inside one step is
mpe2's: contact forces, positions, velocities, then rewards, costs and observations.
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
    """The part of a ``ParticleConfig`` that the compiled code reads."""

    task: int  # index in TASKS
    max_cycles: int
    is_team: np.ndarray  # (A,) bool
    sizes: np.ndarray  # (E,)
    collides: np.ndarray  # (E,) bool
    max_speeds: np.ndarray  # (A,)
    counted: np.ndarray  # (A, E) bool, whose contact costs
    views: np.ndarray  # (2, 5) bool, fields of View for opponents and team


class State(NamedTuple):
    """Everything that changes during an episode, except the random streams."""

    positions: np.ndarray  # (W, E, 2)
    velocities: np.ndarray  # (W, A, 2)
    goals: np.ndarray  # (W,) landmark, 0 where there is none
    clock: np.ndarray  # (W,) steps of the running episode
    starts: np.ndarray  # (W, E, 2) where the episode began, for the scale of the picture only


class Outcome(NamedTuple):
    """What one step reports."""

    team: np.ndarray  # (W, team, D) observations
    opponents: np.ndarray  # (W, opponents, D) observations
    rewards: np.ndarray  # (W, A)
    costs: np.ndarray  # (W, A)
    truncated: np.ndarray  # (W,) bool


_NO_FORCE = -746.0  # exp() of less is exactly zero


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
    """Fill the observations (R, agents of the group, D) of the given worlds (R,)."""
    _observe_worlds(Rules(*rules), State(*state), worlds, team, opponents)


@_compiled
def _step_worlds(rules, state, controls, out):
    for w in range(len(controls)):
        _push(rules.collides, rules.sizes, state.positions[w], controls[w])
        _move(rules.max_speeds, state.positions[w], state.velocities[w], controls[w])
        _reward(rules, state.positions[w], state.goals[w], out.rewards[w])
        _cost(rules.counted, rules.sizes, state.positions[w], out.costs[w])
        state.clock[w] += 1
        out.truncated[w] = state.clock[w] >= rules.max_cycles
    _observe_worlds(rules, state, np.arange(len(controls)), out.team, out.opponents)


@_compiled
def _distance(positions, i, j):
    dx = positions[i, 0] - positions[j, 0]
    dy = positions[i, 1] - positions[j, 1]
    return math.sqrt(dx * dx + dy * dy)


@_compiled
def _touch(sizes, positions, i, j):
    return _distance(positions, i, j) < sizes[i] + sizes[j]


@_compiled
def _push(collides, sizes, positions, forces):
    """Add the soft contact forces between bodies that collide."""
    n_agents = len(forces)
    for i in range(n_agents):  # landmarks do not move, so pairs of them do not matter
        for j in range(i + 1, len(positions)):
            if not (collides[i] and collides[j]):
                continue
            distance = _distance(positions, i, j)
            depth = -(distance - (sizes[i] + sizes[j])) / _CONTACT_MARGIN
            if depth < _NO_FORCE:
                continue
            # log(1 + exp(depth)), without overflow
            softened = max(depth, 0.0) + math.log1p(math.exp(-abs(depth)))
            for axis in range(2):
                direction = _CONTACT_FORCE * (positions[i, axis] - positions[j, axis]) / distance
                force = direction * (softened * _CONTACT_MARGIN)
                forces[i, axis] += force
                if j < n_agents:
                    forces[j, axis] -= force


@_compiled
def _move(max_speeds, positions, velocities, forces):
    """Positions by the old velocities, then velocities; their norm is clipped."""
    for i in range(len(forces)):
        for axis in range(2):
            positions[i, axis] += velocities[i, axis] * _DT
            velocities[i, axis] = velocities[i, axis] * (1.0 - _DAMPING) + forces[i, axis] * _DT
        speed = math.sqrt(velocities[i, 0] ** 2 + velocities[i, 1] ** 2)
        if speed > max_speeds[i]:
            for axis in range(2):
                velocities[i, axis] = velocities[i, axis] / speed * max_speeds[i]


@_compiled
def _reward(rules, positions, goal, rewards):
    if rules.task == _DECEPTION or rules.task == _KEEP_AWAY:
        _reward_goal(rules.task, rules.is_team, positions, len(rewards) + goal, rewards)
    else:
        _reward_hunt(rules.is_team, rules.sizes, positions, rewards)


@_compiled
def _reward_goal(task, is_team, positions, goal, rewards):
    """Deception: closest of the team against the adversary. Keep away: everyone for oneself."""
    closest, others = np.inf, 0.0
    for i in range(len(rewards)):
        rewards[i] = -_distance(positions, i, goal)
        if is_team[i]:
            closest = min(closest, _distance(positions, i, goal))
        else:
            others += _distance(positions, i, goal)
    for i in range(len(rewards)):
        if task == _DECEPTION and is_team[i]:
            rewards[i] = -closest + others
        elif task == _KEEP_AWAY and not is_team[i]:
            rewards[i] = closest - _distance(positions, i, goal)


@_compiled
def _reward_hunt(is_team, sizes, positions, rewards):
    """Predators share 10 per touch of the prey; the prey loses it, and more when it is outside."""
    touches = 0
    for i in range(len(rewards)):
        if is_team[i]:
            continue
        caught = 0
        for j in range(len(rewards)):
            if is_team[j] and _touch(sizes, positions, i, j):
                caught += 1
        touches += caught
        outside = _outside(abs(positions[i, 0])) + _outside(abs(positions[i, 1]))
        rewards[i] = -10.0 * caught - outside
    for i in range(len(rewards)):
        if is_team[i]:
            rewards[i] = 10.0 * touches


@_compiled
def _outside(x):
    if x < 0.9:
        return 0.0
    return (x - 0.9) * 10.0 if x < 1.0 else min(math.exp(2.0 * x - 2.0), 10.0)


@_compiled
def _cost(counted, sizes, positions, costs):
    for i in range(len(costs)):
        costs[i] = 0.0
        for j in range(len(positions)):
            if counted[i, j] and _touch(sizes, positions, i, j):
                costs[i] = 1.0


@_compiled
def _observe_worlds(rules, state, worlds, team, opponents):
    for row in range(len(worlds)):
        w = worlds[row]
        positions, velocities = state.positions[w], state.velocities[w]
        n_team = 0
        for i in range(len(velocities)):
            if rules.is_team[i]:
                out = team[row, n_team]
                n_team += 1
            else:
                out = opponents[row, i - n_team]
            _observe(rules.is_team, rules.views, i, positions, velocities, state.goals[w], out)


@_compiled
def _observe(is_team, views, i, positions, velocities, goal, out):
    n_agents, n_entities = len(velocities), len(positions)
    velocity, position, sees_goal, colors, prey_velocity = views[int(is_team[i])]
    end = 0
    if velocity:
        end = _append(out, end, velocities[i, 0], velocities[i, 1])
    if position:
        end = _append(out, end, positions[i, 0], positions[i, 1])
    if sees_goal:
        end = _append_relative(out, end, positions, i, n_agents + goal)
    if colors:
        end = _append_color(out, end, 0.25, 0.5, goal)
    end = _append_range(out, end, positions, i, n_agents, n_entities)
    if colors:
        for landmark in range(n_entities - n_agents):
            end = _append_color(out, end, 0.1, 0.8, landmark)
    end = _append_range(out, end, positions, i, 0, n_agents)
    if prey_velocity:
        _append_prey(is_team, out, end, velocities)


@_compiled
def _append_range(out, end, positions, i, first, stop):
    """Relative positions of a range of entities, without the agent itself."""
    for j in range(first, stop):
        if j != i:
            end = _append_relative(out, end, positions, i, j)
    return end


@_compiled
def _append_prey(is_team, out, end, velocities):
    for j in range(len(velocities)):
        if not is_team[j]:
            end = _append(out, end, velocities[j, 0], velocities[j, 1])


@_compiled
def _append(out, end, x, y):
    out[end] = x
    out[end + 1] = y
    return end + 2


@_compiled
def _append_relative(out, end, positions, i, j):
    return _append(out, end, positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1])


@_compiled
def _append_color(out, end, gray, more, landmark):
    """A color in which channel ``landmark`` + 1 stands out."""
    for channel in range(3):
        out[end + channel] = gray + (more if channel == landmark + 1 else 0.0)
    return end + 3
