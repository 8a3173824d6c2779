"""Observation-entropy bonuses (Alg. 1 l. 3-10): visit counts and nearest neighbors.

An estimator keeps one memory per slot, the paper's ``b^i``: what this agent has observed since its
episode began. An observation is scored against that memory and stored afterwards, so it is never
its own neighbor; ``o_0`` is not scored and therefore not stored. ``callbacks`` turns the bonus
into a reward (lines 11-17). ``S`` slots, ``D`` numbers per observation.
"""

import sys
from numbers import Integral, Real
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numba import njit


@runtime_checkable
class EntropyEstimator(Protocol):
    """What the reward callback needs to know of an estimator; write your own with these three."""

    def reset(self, n_slots: int) -> None:
        """Start with empty memories.

        :param n_slots: S, number of slots that every later call has
        """

    def score(self, observations: np.ndarray) -> np.ndarray:
        """Bonus of one new observation per slot, which is then stored (Alg. 1 l. 3-10).

        :param observations: o_{t+1}, shape (S, D)
        :return: bonus before ``beta`` and ``psi``, shape (S,)
        """

    def forget(self, slots: np.ndarray) -> None:
        """Empty the memories of slots whose episode has ended.

        :param slots: True where the episode has ended, shape (S,)
        """


class VisitCount:
    """Bonus 1 / n: n visits to this quantized observation in this episode (Alg. 1 l. 4-5).

    The paper counts before it stores, hence 1 / 0 at a first visit; here the count includes the
    present visit, so that first visits earn 1 and second ones 1/2.

    Level 1 only asks whether a number says "nothing here" (``empty``) or something. Level q >= 2
    also sorts what is there into q bins of equal width between 0 and ``high``.

    :param quantization: level q (Table 1: 1)
    :param empty: the value that means "nothing here", -1 for the rovers' sensors; compared up to a
        relative error of 1e-5, as float32 observations hold neither -0.1 nor an undone
        normalization exactly
    :param high: largest value that is told apart, needed from level 2 on
    """

    def __init__(
        self, quantization: int = 1, empty: float = -1.0, high: float | None = None
    ) -> None:
        self.quantization = _positive_integer("quantization", quantization)
        self.empty = _finite_number("empty", empty)
        if self.quantization > 1 and high is None:
            raise ValueError(
                f"quantization={quantization} sorts values into bins between 0 and `high`, but no "
                "`high` was given: pass the largest value of an observation, or use quantization=1."
            )
        self.high = None if high is None else _finite_number("high", high)
        if self.high is not None and self.high <= 0:
            raise ValueError(f"high must be greater than 0, got {high}.")
        self._memory = _EpisodeMemory(np.int32)

    def reset(self, n_slots: int) -> None:
        """See :meth:`EntropyEstimator.reset`."""
        self._memory.reset(n_slots)

    def score(self, observations: np.ndarray) -> np.ndarray:
        """See :meth:`EntropyEstimator.score`."""
        codes = self.quantize(observations)
        self._memory.prepare(codes)
        return 1.0 / _count_visits(codes, self._memory.columns, self._memory.filled)

    def forget(self, slots: np.ndarray) -> None:
        """See :meth:`EntropyEstimator.forget`."""
        self._memory.forget(slots)

    def quantize(self, observations: np.ndarray) -> np.ndarray:
        """Replace each number by 0 (empty) or by the number of its bin, 1 to q.

        :param observations: any shape
        :return: codes, int32, same shape
        """
        observations = np.asarray(observations, dtype=np.float64)
        something = np.abs(observations - self.empty) > 1e-5 * abs(self.empty)
        if self.high is None or self.quantization == 1:
            return something.astype(np.int32)
        bins = np.floor(observations * (self.quantization / self.high)) + 1
        return np.where(something, np.clip(bins, 1, self.quantization), 0).astype(np.int32)


class NearestNeighbor:
    """Bonus log(D_k + 1): distance to the k-th nearest earlier observation (Alg. 1 l. 7-8).

    Distances are Euclidean, among the observations of this slot's running episode. While fewer
    than k are stored, the farthest of them counts; without any, the bonus is 0.

    :param k: which neighbor (Table 1: 5 in the particle environments, 10 in MaMuJoCo)
    """

    def __init__(self, k: int) -> None:
        self.k = _positive_integer("k", k)
        self._memory = _EpisodeMemory(np.float32)

    def reset(self, n_slots: int) -> None:
        """See :meth:`EntropyEstimator.reset`."""
        self._memory.reset(n_slots)

    def score(self, observations: np.ndarray) -> np.ndarray:
        """See :meth:`EntropyEstimator.score`."""
        observations = np.ascontiguousarray(observations, dtype=np.float32)
        self._memory.prepare(observations)
        distances = _kth_distances(observations, self._memory.columns, self._memory.filled, self.k)
        return np.log1p(distances)

    def forget(self, slots: np.ndarray) -> None:
        """See :meth:`EntropyEstimator.forget`."""
        self._memory.forget(slots)


class _EpisodeMemory:
    """One growing list of observations per slot, in one array so that a kernel handles all slots.

    ``columns`` (S, D, capacity) and ``filled`` (S,): the n-th observation of slot s is
    ``columns[s, :, n]``. The observations lie along the last axis, where the kernels' inner loops
    run: they are long, and compile to vector instructions for any D.
    """

    def __init__(self, dtype: type[np.generic]) -> None:
        self.dtype = dtype
        self.columns = np.zeros((0, 0, 0), dtype)
        self.filled = np.zeros(0, np.int64)

    def reset(self, n_slots: int) -> None:
        self.columns = np.zeros((_positive_integer("n_slots", n_slots), 0, 0), self.dtype)
        self.filled = np.zeros(n_slots, np.int64)

    def prepare(self, new: np.ndarray) -> None:
        """Check a batch and make room for one more observation in every slot.

        :param new: what is to come, shape (S, D)
        """
        n_slots, size, capacity = self.columns.shape
        if n_slots == 0:
            raise ValueError("The estimator has no slots yet: call reset(n_slots) before score().")
        if new.ndim != 2 or len(new) != n_slots or new.shape[1] == 0:
            raise ValueError(
                f"Expected observations of shape ({n_slots}, D), one row for each of the {n_slots} "
                f"slots of reset(), got shape {new.shape}."
            )
        if capacity > 0 and new.shape[1] != size:
            raise ValueError(
                f"Observations had {size} numbers before and now have {new.shape[1]}: call reset() "
                "when the observations change."
            )
        if self.filled.max() >= capacity:
            columns = np.zeros((n_slots, new.shape[1], max(64, 2 * capacity)), self.dtype)
            columns[:, :size, :capacity] = self.columns
            self.columns = columns

    def forget(self, slots: np.ndarray) -> None:
        self.filled[np.asarray(slots, dtype=bool)] = 0


@njit(cache=True)
def _count_visits(codes: np.ndarray, columns: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Count the visits to each slot's code, this one included; then store it (Alg. 1 l. 4, 10).

    :param codes: quantized observations, shape (S, D)
    :param columns: earlier codes, shape (S, D, capacity)
    :param filled: number of them, shape (S,)
    :return: visits, at least 1, shape (S,)
    """
    visits = np.ones(len(codes), np.int64)
    differing_bits = np.empty(columns.shape[2], columns.dtype)
    for slot in range(len(codes)):
        n = filled[slot]
        differing_bits[:n] = 0
        for d in range(codes.shape[1]):
            code, earlier = codes[slot, d], columns[slot, d]
            for i in range(n):
                differing_bits[i] |= earlier[i] ^ code
            earlier[n] = code
        for i in range(n):
            visits[slot] += differing_bits[i] == 0
        filled[slot] += 1
    return visits


# A long memory does not fit into a processor's cache. The first so many numbers of an observation
# show of most earlier ones that they are too far away; the rest of those is never read.
_GLANCE = 16
# It pays if fewer than one in so many is left after the glance,
_FEW = 8
# and if there are at least so many numbers.
_SMALL = 16_384
# Those that are left are searched for in blocks, most of which have none.
_BLOCK = 64


@njit(cache=True)
def _kth_distances(
    observations: np.ndarray, columns: np.ndarray, filled: np.ndarray, k: int
) -> np.ndarray:
    """Distance of each slot's observation to its k-th neighbor; then store it (Alg. 1 l. 7, 10).

    :param observations: o_{t+1}, shape (S, D)
    :param columns: earlier observations, shape (S, D, capacity)
    :param filled: number of them, shape (S,)
    :param k: which neighbor; the farthest one where there are fewer
    :return: distances, 0 without neighbors, shape (S,)
    """
    distances = np.zeros(len(observations))
    squared = np.empty(columns.shape[2], np.float32)
    nearest = np.empty(min(k, columns.shape[2]), np.float32)
    for slot in range(len(observations)):
        n = filled[slot]
        if n > 0:
            least = _kth_squared_distance(observations[slot], columns[slot], squared[:n], nearest)
            distances[slot] = np.sqrt(np.float64(least))
        columns[slot, :, n] = observations[slot]
        filled[slot] += 1
    return distances


@njit(cache=True)
def _kth_squared_distance(
    query: np.ndarray, columns: np.ndarray, squared: np.ndarray, nearest: np.ndarray
) -> np.float32:
    """Squared distance of the k-th nearest of n observations, or of the farthest if fewer.

    :param query: shape (D,)
    :param columns: shape (D, capacity)
    :param squared: work space, shape (n,)
    :param nearest: work space, shape (k,)
    """
    n, k = len(squared), min(len(nearest), len(squared))
    nearest[:k] = np.inf
    squared[:] = 0.0
    if n * len(query) < _SMALL:
        _add_squares(query, columns, 0, len(query), 0, n, squared)
        _keep_smallest(squared, nearest[:k])
        return nearest[k - 1]
    recent = max(n - 4 * k, 0)  # the latest ones are the closest in a trajectory: look there first
    _add_squares(query, columns, 0, len(query), recent, n, squared)
    _keep_smallest(squared[recent:], nearest[:k])
    glance = min(_GLANCE, len(query))
    _add_squares(query, columns, 0, glance, 0, recent, squared)
    if _count_below(squared[:recent], nearest[k - 1]) * _FEW > recent:
        _add_squares(query, columns, glance, len(query), 0, recent, squared)
        _keep_smallest(squared[:recent], nearest[:k])
        return nearest[k - 1]
    for begin in range(0, recent, _BLOCK):
        end = min(begin + _BLOCK, recent)
        if _count_below(squared[begin:end], nearest[k - 1]) > 0:
            for i in range(begin, end):
                if squared[i] < nearest[k - 1]:
                    _add_squares(query, columns, glance, len(query), i, i + 1, squared)
                    _keep_smallest(squared[i : i + 1], nearest[:k])
    return nearest[k - 1]


@njit(cache=True)
def _count_below(numbers: np.ndarray, bound: np.float32) -> int:
    count = 0
    for i in range(len(numbers)):
        count += numbers[i] < bound
    return count


@njit(cache=True)
def _add_squares(
    query: np.ndarray,
    columns: np.ndarray,
    begin: int,
    end: int,
    first: int,
    last: int,
    squared: np.ndarray,
) -> None:
    """Add squared differences in some numbers of the observations, four of them at a time.

    Differences come before squares, so near duplicates keep their relative precision, unlike with
    |a|^2 - 2ab + |b|^2.

    :param query: shape (D,)
    :param columns: shape (D, capacity)
    :param begin: first of the numbers
    :param end: one past the last of them
    :param first: first of the observations
    :param last: one past the last of them
    :param squared: the sums, shape (n,)
    """
    whole = end - (end - begin) % 4
    for d in range(begin, whole, 4):
        a, b, c, e = columns[d], columns[d + 1], columns[d + 2], columns[d + 3]
        qa, qb, qc, qe = query[d], query[d + 1], query[d + 2], query[d + 3]
        for i in range(first, last):
            ab = (a[i] - qa) * (a[i] - qa) + (b[i] - qb) * (b[i] - qb)
            squared[i] += ab + ((c[i] - qc) * (c[i] - qc) + (e[i] - qe) * (e[i] - qe))
    for d in range(whole, end):
        a, qa = columns[d], query[d]
        for i in range(first, last):
            squared[i] += (a[i] - qa) * (a[i] - qa)


@njit(cache=True)
def _keep_smallest(numbers: np.ndarray, smallest: np.ndarray) -> None:
    """Insert numbers into a list of the smallest ones, the last number first.

    :param numbers: shape (n,)
    :param smallest: in ascending order, shape (k,)
    """
    for i in range(len(numbers) - 1, -1, -1):
        place = len(smallest) - 1
        if numbers[i] < smallest[place]:
            while place > 0 and smallest[place - 1] > numbers[i]:
                smallest[place] = smallest[place - 1]
                place -= 1
            smallest[place] = numbers[i]


def _positive_integer(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}.")
    return int(value)


def _finite_number(name: str, value: Any) -> float:
    largest = sys.float_info.max  # whole numbers can be larger
    if isinstance(value, bool) or not isinstance(value, Real) or not abs(value) <= largest:  # type: ignore[operator]
        raise ValueError(f"{name} must be a finite number, got {value!r}.")
    return float(value)
