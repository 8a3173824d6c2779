"""Log-probabilities and entropies of actions with their gradients, in compiled loops.

The numbers of ``torch.distributions.Normal`` and ``Categorical``, which take ten operations and as
many backward.

Shapes: n actions of A numbers, or one of A choices.
"""

from typing import NamedTuple

import numpy as np
import torch as th
from numba import njit

_HALF_LOG_2PI = np.float32(0.5 * np.log(2 * np.pi))


class Rating(NamedTuple):
    """How likely actions are, and how uncertain the policy was; or gradients there."""

    log_prob: th.Tensor  # (n,)
    entropy: th.Tensor  # (n,)


class GaussianRating:
    """Independent normal distributions with standard deviations that are the same everywhere.

    :param log_std: log σ, shape (A,)
    :param log_std_gradient: Where the gradient of log σ belongs, shape (A,)
    """

    def __init__(self, log_std: th.Tensor, log_std_gradient: th.Tensor):
        self._log_std, self._gradient = log_std.detach(), log_std_gradient

    def rate(self, means: th.Tensor, actions: th.Tensor) -> Rating:
        """Rate actions.

        :param means: μ, shape (n, A)
        :param actions: u, shape (n, A)
        """
        rating = Rating(th.empty(len(means)), th.empty(len(means)))
        self._arrays = (means.numpy(), self._log_std.numpy(), actions.numpy())
        _rate_gaussian(*self._arrays, *(each.numpy() for each in rating))
        return rating

    def gradient(self, known: Rating) -> th.Tensor:
        """Gradient at the means of the last actions, shape (n, A); also keeps that of log σ.

        :param known: Gradients at their rating
        """
        gradient = th.empty(self._arrays[0].shape)
        arrays = (each.numpy() for each in (*known, gradient, self._gradient))
        _gaussian_gradient(*self._arrays, *arrays)
        return gradient


class CategoricalRating:
    """One of A choices."""

    def rate(self, logits: th.Tensor, actions: th.Tensor) -> Rating:
        """Rate actions.

        :param logits: Not normalized, shape (n, A)
        :param actions: Indices, shape (n,)
        """
        rating = Rating(th.empty(len(logits)), th.empty(len(logits)))
        log_probs = th.log_softmax(logits, dim=1)
        self._arrays = (log_probs.numpy(), actions.numpy(), rating.entropy.numpy())
        _rate_categorical(*self._arrays, rating.log_prob.numpy())
        return rating

    def gradient(self, known: Rating) -> th.Tensor:
        """Gradient at the logits of the last actions, shape (n, A).

        :param known: Gradients at their rating
        """
        gradient = th.empty(self._arrays[0].shape)
        _categorical_gradient(*self._arrays, *(each.numpy() for each in (*known, gradient)))
        return gradient


@njit(cache=True, error_model="numpy", nogil=True)
def _rate_gaussian(means, log_std, actions, log_prob, entropy):
    """Rate with z = (u − μ) / σ: log π = −Σ z²/2 + log σ + log(2π)/2, H = Σ log σ + (1 + log 2π)/2.

    :param means: μ, shape (n, A)
    :param log_std: log σ, shape (A,)
    :param actions: u, shape (n, A)
    :param log_prob: a result, shape (n,)
    :param entropy: a result, shape (n,)
    """
    half = np.float32(0.5)
    inverse = np.exp(-log_std)
    level = np.float32(0.0)
    for j in range(len(log_std)):
        level += log_std[j] + _HALF_LOG_2PI
    for i in range(len(means)):
        squares = np.float32(0.0)
        for j in range(len(log_std)):
            z = (actions[i, j] - means[i, j]) * inverse[j]
            squares += z * z
        log_prob[i] = -half * squares - level
        entropy[i] = level + half * np.float32(len(log_std))


@njit(cache=True, error_model="numpy", nogil=True)
def _gaussian_gradient(means, log_std, actions, of_log_prob, of_entropy, of_means, of_log_std):
    """Derivatives: ∂ log π / ∂μ = z / σ, ∂ log π / ∂ log σ = z² − 1, ∂H / ∂ log σ = 1.

    :param means: μ, shape (n, A)
    :param log_std: log σ, shape (A,)
    :param actions: u, shape (n, A)
    :param of_log_prob: gradient at log π, shape (n,)
    :param of_entropy: gradient at H, shape (n,)
    :param of_means: a result, shape (n, A)
    :param of_log_std: a result, shape (A,)
    """
    one = np.float32(1.0)
    inverse = np.exp(-log_std)
    total = np.zeros(len(log_std))
    for i in range(len(means)):
        for j in range(len(log_std)):
            z = (actions[i, j] - means[i, j]) * inverse[j]
            of_means[i, j] = of_log_prob[i] * z * inverse[j]
            total[j] += of_log_prob[i] * (z * z - one) + of_entropy[i]
    of_log_std[:] = total


@njit(cache=True, error_model="numpy", nogil=True)
def _rate_categorical(log_probs, actions, entropy, log_prob):
    """Rate the choices made: log π(a), and H = −Σ π log π.

    :param log_probs: log π of all choices, shape (n, A)
    :param actions: shape (n,)
    :param entropy: a result, shape (n,)
    :param log_prob: a result, shape (n,)
    """
    for i in range(len(actions)):
        log_prob[i] = log_probs[i, actions[i]]
        total = np.float32(0.0)
        for each in log_probs[i]:
            if each > -np.inf:  # a choice that cannot be made adds nothing
                total -= np.exp(each) * each
        entropy[i] = total


@njit(cache=True, error_model="numpy", nogil=True)
def _categorical_gradient(log_probs, actions, entropy, of_log_prob, of_entropy, gradient):
    """Derivatives: ∂ log π(a) / ∂lⱼ = [j = a] − πⱼ, ∂H / ∂lⱼ = −πⱼ (log πⱼ + H).

    :param log_probs: log π of all choices, shape (n, A)
    :param actions: a, shape (n,)
    :param entropy: H, shape (n,)
    :param of_log_prob: gradient at log π(a), shape (n,)
    :param of_entropy: gradient at H, shape (n,)
    :param gradient: the result, at the logits l, shape (n, A)
    """
    for i in range(len(actions)):
        for j in range(log_probs.shape[1]):
            p = np.exp(log_probs[i, j])
            slope = -p * of_log_prob[i]
            if p > 0:
                slope -= of_entropy[i] * p * (log_probs[i, j] + entropy[i])
            gradient[i, j] = slope
        gradient[i, actions[i]] += of_log_prob[i]
