"""The gradient of the objective over a minibatch, on one thread or two (Alg. 2 l. 13-16).

Two threads compute half of every minibatch each. Gradients are added in the same order every time,
so that a run can be repeated bit for bit. Python threads suit it better than torch's own: these
wait for each other in every operation of some 50 µs, ours once in a minibatch.
"""

import math
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_e2c.buffers import TeamSamples, halves
from sb3_e2c.objective import Targets, Terms, Weights, objective
from sb3_e2c.passes import STATELESS, MlpPasses, Passes
from sb3_e2c.policies import RunningNorm, TeamMlpExtractor, TeamPolicy
from sb3_e2c.recurrent import GruPolicy
from sb3_e2c.sequences import Sequences

# From this many agent steps on, a minibatch is computed in halves. In smaller ones the threads wait
# for Python's lock as long as they save.
HALVED_FROM = 3000

# Layers that treat every row alone and hold no state, so that threads may share them. (Dropout
# would draw from torch's one generator in any order, batch normalization sees one half only.)
_SHARED = (
    *(nn.Linear, nn.GRU, nn.Tanh, nn.ReLU, nn.LeakyReLU, nn.ELU, nn.SiLU, nn.GELU, nn.Sigmoid),
    *(nn.Sequential, nn.Identity, nn.Flatten, FlattenExtractor, TeamMlpExtractor, RunningNorm),
)


class Descent:
    """Computes gradients and clips them, for one update; a context manager that owns a thread.

    :param policy: The networks
    :param n_threads: 1 or 2; where a single core is free, one thread computes both halves
    """

    def __init__(self, policy: TeamPolicy, n_threads: int):
        for parameter in policy.parameters():  # one that was frozen keeps no old gradient
            parameter.grad = None
        groups = [[p for p in group if p.requires_grad] for group in policy.clipped_together()]
        self._parameters = [parameter for group in groups for parameter in group]
        self._sizes = [sum(parameter.numel() for parameter in group) for group in groups]
        kind = MlpPasses if MlpPasses.is_for(policy, self._parameters) else Passes
        self._is_halved = n_threads > 1 and _can_be_halved(policy, self._parameters)
        n_parts = 2 if self._is_halved else 1
        self._passes = [kind(policy, self._parameters) for _ in range(n_parts)]
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> "Descent":
        if self._is_halved and n_cores() > 1:
            # Torch forgets in new threads how many of its own MKL may use.
            self._pool = ThreadPoolExecutor(
                1, "sb3_e2c-update", initializer=th.set_num_threads, initargs=(1,)
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()  # after an error, waits for the half that is being computed
            self._pool = None

    def gradient(self, batch: TeamSamples, sequences: Sequences | None, weights: Weights) -> Terms:
        """Leave the gradient of the objective over a minibatch in the parameters.

        :param batch: The minibatch
        :param sequences: Its sequences, if the policy is recurrent
        :param weights: Settings of the objective
        :return: The terms of the objective
        """
        parts = [(batch, sequences)]
        if self._is_halved and batch.advantages.numel() >= HALVED_FROM:
            parts = halves(batch, sequences)
        total = len(batch.observations)
        tasks = [
            (passes, *part, weights, len(part[0].observations) / total)
            for passes, part in zip(self._passes, parts, strict=False)
        ]
        with _one_torch_thread() if len(tasks) > 1 else nullcontext():
            terms = self._compute(tasks)
        whole = self._passes[0]
        for other in self._passes[1 : len(parts)]:
            whole.gradient.add_(other.gradient)
        for parameter, piece in zip(self._parameters, whole.pieces, strict=True):
            parameter.grad = piece
        return Terms(*map(sum, zip(*terms, strict=True)))

    def _compute(self, tasks: Sequence[Any]) -> list[Terms]:
        if self._pool is None or len(tasks) == 1:
            return [_part(*task) for task in tasks]
        other = self._pool.submit(_part, *tasks[1])
        return [_part(*tasks[0]), other.result()]

    def clip(self, max_norm: float) -> list[float]:
        """Shorten gradients to a length, the cost critics' on their own.

        So watching a cost does not change what the other networks learn (unless they share a
        features extractor that learns).

        :param max_norm: Largest length
        :return: Lengths before; if one is not finite, all gradients are as they were
        """
        pieces = [piece for piece in self._passes[0].gradient.split(self._sizes) if len(piece)]
        norms = [piece.dot(piece).sqrt().item() for piece in pieces]
        if all(map(math.isfinite, norms)):
            for piece, norm in zip(pieces, norms, strict=True):
                if norm + 1e-6 > max_norm:  # as torch's clip_grad_norm_
                    piece.mul_(max_norm / (norm + 1e-6))
        return norms


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Here, and in threads that compute for the first time meanwhile."""
    before = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(before)


def _part(
    passes: Passes,
    batch: TeamSamples,
    sequences: Sequences | None,
    weights: Weights,
    share: float,
) -> Terms:
    """Terms and gradient of a part of a minibatch, on any thread."""
    outputs = passes.forward(batch, sequences)
    targets = Targets(*batch[3:])
    terms, gradients = objective(outputs, targets, weights, share)
    passes.backward(gradients)
    return terms


def _can_be_halved(policy: TeamPolicy, parameters: Sequence[nn.Parameter]) -> bool:
    """Whether two threads may run the networks at once, each on some of the rows."""
    known = (*_SHARED, type(policy))
    return (
        type(policy) in (TeamPolicy, GruPolicy)
        and type(policy.action_dist) in STATELESS
        and all(type(module) in known for module in policy.modules())
        and all(parameter.device.type == "cpu" for parameter in parameters)
    )


def update_threads(wanted: int | None) -> int:
    """How many threads an update shall use.

    :param wanted: 1 or 2; None: 2 if torch would use two (``torch.set_num_threads``; where it may
        use more, they do more than two halves), this process may use several cores, and it is
        nobody's worker
    """
    if wanted is not None:
        return wanted
    is_alone = multiprocessing.parent_process() is None
    return 2 if is_alone and th.get_num_threads() == 2 and n_cores() > 1 else 1


def n_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
