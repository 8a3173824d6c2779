"""A rollout cut into team sequences, for recurrent networks.

A sequence is what one world did from an episode's start, or the rollout's, to its end. Sequences
are never padded: their steps lie in the order of torch's ``PackedSequence``, first the first steps
of all, longest sequence first, then the second steps of those that have one, and so on.

Shapes: T steps, W worlds, N agents, k sequences of at most L steps and B steps in all, H hidden
units, K' = 1 for a team cost critic and N for individual ones.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch as th


class Memory(NamedTuple):
    """Hidden states of the three networks; each field has the shape behind it."""

    actor: th.Tensor  # (k, N, H)
    value: th.Tensor  # (k, 1, H)
    cost: th.Tensor  # (k, K', H)


class Sequences(NamedTuple):
    """How B team steps form k sequences."""

    batch_sizes: (
        th.Tensor
    )  # (L,) int64 on the CPU, falling: sequences that have a first, second, ...
    initial: Memory  # hidden states before the first steps


class Cut(NamedTuple):
    """Where the sequences of a rollout lie, longest first."""

    worlds: np.ndarray  # (k,)
    starts: np.ndarray  # (k,), first step
    lengths: np.ndarray  # (k,), falling


def cut_at_ends(dones: np.ndarray) -> Cut:
    """Cut every world's steps after each episode's end.

    :param dones: Whether a step ended an episode, shape (T, W)
    :return: All sequences of the rollout
    """
    n_steps, n_worlds = dones.shape
    begins = np.ones((n_steps, n_worlds), bool)
    begins[1:] = dones[:-1]
    worlds, starts = np.nonzero(begins.T)
    ends = np.append(starts[1:], n_steps)
    ends[np.append(worlds[1:] != worlds[:-1], True)] = n_steps
    order = np.argsort(starts - ends, kind="stable")
    return Cut(worlds[order], starts[order], (ends - starts)[order])


def packed_rows(cut: Cut, n_worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Order the steps of sequences as ``PackedSequence`` wants them.

    :param cut: Sequences, longest first
    :param n_worlds: W
    :return: Rows of the flattened rollout (step · W + world), shape (B,), and how many sequences
        have a first, second, ... step, shape (L,)
    """
    steps = np.arange(cut.lengths[0])[:, None]
    alive = steps < cut.lengths
    rows = (cut.starts + steps) * n_worlds + cut.worlds
    return rows[alive], alive.sum(axis=1)


def initial_memory(cut: Cut, at_rollout_start: Memory) -> Memory:
    """Hidden states before each sequence: carried over into the rollout, zero at episode starts.

    :param cut: k sequences
    :param at_rollout_start: Hidden states of all W worlds before the rollout
    :return: Hidden states for k sequences
    """
    device = at_rollout_start.actor.device
    carried = th.as_tensor(cut.starts == 0, device=device)[:, None, None]
    worlds = th.as_tensor(cut.worlds, device=device)
    return Memory(*(states[worlds] * carried for states in at_rollout_start))


def random_groups(cut: Cut, n_team_steps: int) -> Iterator[Cut]:
    """Divide sequences at random into groups of about equal numbers of team steps.

    :param cut: All sequences
    :param n_team_steps: About the largest number of team steps in a group; sequences stay whole
    :return: Groups that together hold every sequence once
    """
    n_steps = int(cut.lengths.sum())
    n_groups = min(-(-n_steps // n_team_steps), len(cut.worlds))
    if n_groups == 1:
        yield cut
        return
    order = np.random.permutation(len(cut.worlds))
    lengths = cut.lengths[order]
    middles = np.cumsum(lengths) - lengths / 2
    groups = (middles * n_groups / n_steps).astype(int)
    for chosen in (np.sort(order[groups == g]) for g in range(n_groups)):  # the longest first
        if len(chosen):
            yield Cut(*(field[chosen] for field in cut))


def alternate(sequences: Sequences) -> list[tuple[th.Tensor, Sequences]]:
    """Divide sequences among two, every other one, so that both halves have long and short ones.

    :param sequences: k sequences, longest first
    :return: Rows of each half, and its sequences; one half if there is a single sequence
    """
    sizes = sequences.batch_sizes
    starts = th.repeat_interleave(sizes.cumsum(0) - sizes, sizes)
    parity = (th.arange(int(sizes.sum())) - starts) % 2
    parts = []
    for half in (0, 1):
        own = (sizes + 1 - half) // 2
        memory = Memory(*(states[half::2] for states in sequences.initial))
        rows = th.nonzero(parity == half).squeeze(1)
        parts.append((rows, Sequences(own[own > 0], memory)))
    return [part for part in parts if len(part[0])]
