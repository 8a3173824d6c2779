"""Many seeds as one curve, one number with an interval, or one comparison.

A seed is one run: all intervals and tests here are over seeds, never over episodes. They take runs
as independent. Networks and actions are; neighbouring seeds share most of the worlds' random
numbers (world w has seed + w, as in Stable-Baselines3), though not those of the evaluation.
"""

import warnings
from collections.abc import Sequence
from math import comb
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from sb3_e2c.evaluation import standard_error

CONFIDENCE = 0.95
FEWEST_FOR_INTERVAL = 3  # two seeds have three different resamples
_RESAMPLES = 10_000
_GRID = 200  # points of a curve


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the first axis, and its standard error; 0 for a single seed.

    :param values: Shape (R, ...), R seeds
    :return: Both of shape (...)
    """
    return values.mean(axis=0), standard_error(values)


def on_common_steps(
    steps: Sequence[np.ndarray], values: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Curves of several seeds at the same steps, where all of them have values.

    Curves with equal steps are left as they are; others are interpolated.

    :param steps: R arrays, increasing
    :param values: R arrays of the same shapes
    :return: Steps, shape (G,), and values, shape (R, G)
    """
    if all(np.array_equal(each, steps[0]) for each in steps):
        return steps[0], np.stack(list(values))
    first, last = max(each[0] for each in steps), min(each[-1] for each in steps)
    grid = np.linspace(first, max(first, last), _GRID)
    return grid, np.stack([np.interp(grid, s, v) for s, v in zip(steps, values, strict=True)])


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half: a quarter of the seeds (rounded down) is dropped at each end.

    :param values: Any shape
    :param axis: The axis of the seeds
    """
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def bootstrap_interval(values: np.ndarray) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of the interquartile mean.

    :param values: Shape (R,)
    :return: Its ends; None for fewer than three seeds
    """
    if len(values) < FEWEST_FOR_INTERVAL:
        return None
    result = stats.bootstrap(
        (values,),
        interquartile_mean,
        n_resamples=_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",  # the better BCa is undefined where all seeds agree
        rng=np.random.default_rng(0),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


class Comparison(NamedTuple):
    """A method against a baseline.

    :param difference: Mean of the method minus mean of the baseline
    :param low: Lower end of its 95 % interval (Welch)
    :param high: Upper end
    :param welch: Two-sided p-value of Welch's t-test
    :param mann_whitney: Two-sided p-value of the Mann-Whitney U test, from permutations
    """

    difference: float
    low: float
    high: float
    welch: float
    mann_whitney: float


def compare(method: np.ndarray, baseline: np.ndarray) -> Comparison | None:
    """Test whether two sets of seeds have different means.

    :param method: Shape (R,)
    :param baseline: Shape (Q,)
    :return: None if there are fewer than two seeds of either, or no spread in both
    """
    if min(len(method), len(baseline)) < 2 or np.ptp(method) == np.ptp(baseline) == 0:
        return None
    with warnings.catch_warnings():  # seeds of one of them may agree to the last digit
        warnings.simplefilter("ignore", RuntimeWarning)
        welch = stats.ttest_ind(method, baseline, equal_var=False)
    interval = welch.confidence_interval(CONFIDENCE)
    ranks = stats.mannwhitneyu(method, baseline, method=_exact(np.append(method, baseline)))
    difference = float(method.mean() - baseline.mean())
    ends = float(interval.low), float(interval.high)
    return Comparison(difference, *ends, float(welch.pvalue), float(ranks.pvalue))


def _exact(values: np.ndarray) -> Any:
    """How scipy gets p-values of ranks for few seeds: its formula takes no ties."""
    tied = len(np.unique(values)) < len(values)
    return stats.PermutationMethod(_RESAMPLES, rng=np.random.default_rng(0)) if tied else "exact"


def smallest_mann_whitney(n: int, m: int) -> float:
    """The smallest two-sided p-value that ranks of n and m seeds can give: full separation.

    :param n: Seeds of one method
    :param m: Seeds of the other
    """
    return min(2 / comb(n + m, n), 1.0)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for their number (Holm's step-down method).

    :param p_values: Shape (K,), of K tests that are read together
    :return: Shape (K,), in the same order
    """
    adjusted = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable").tolist()):
        largest = max(largest, min((len(p_values) - rank) * p_values[index], 1.0))
        adjusted[index] = largest
    return adjusted


def first_step_near_peak(steps: np.ndarray, values: np.ndarray, share: float = 0.9) -> float:
    """The first step at which a curve has risen by ``share`` of its whole rise.

    The rise begins at the lowest value: beside an adversary that learns, too, returns may fall
    before they rise.

    :param steps: Shape (G,)
    :param values: Shape (G,)
    :param share: Of the way from the lowest value to the highest after it
    """
    lowest = int(np.argmin(values))
    rise = values[lowest:]
    threshold = rise[0] + share * (rise.max() - rise[0])
    return float(steps[lowest + np.argmax(rise >= threshold)])
