"""A GRU over sequences of uneven lengths, several times faster on a CPU than ``torch.nn.GRU``.

torch runs a dozen small operations for every step, and as many backward. Here one matrix product
projects the inputs of all steps, every step is one matrix product and one compiled loop over the
gates, and the gradient of the recurrent weights is a single product at the end.

Shapes: B steps of k sequences in the order of ``PackedSequence``, L steps of the longest, F inputs,
H hidden units. Gates are those of ``torch.nn.GRU``, in its order r, z, n:

    r = σ(x Wᵢᵣ + bᵢᵣ + h Wₕᵣ + bₕᵣ),  z = σ(x Wᵢ𝓏 + bᵢ𝓏 + h Wₕ𝓏 + bₕ𝓏)
    n = tanh(x Wᵢₙ + bᵢₙ + r (h Wₕₙ + bₕₙ)),  h' = n + z (h − n)
"""

from typing import Any

import numpy as np
import torch as th
from numba import njit
from torch import nn
from torch.nn import functional as F
from torch.nn.utils.rnn import PackedSequence


def run_sequences(
    gru: nn.GRU, inputs: th.Tensor, batch_sizes: th.Tensor, initial: th.Tensor
) -> th.Tensor:
    """Hidden states after every step of sequences.

    :param gru: One layer; gradients reach its parameters and the inputs, not ``initial``
    :param inputs: Shape (B, F)
    :param batch_sizes: How many sequences have a first, second, ... step, falling, shape (L,)
    :param initial: Hidden states before the first steps, shape (k, H)
    :return: Shape (B, H)
    """
    if not _is_supported(inputs):
        return gru(PackedSequence(inputs, batch_sizes), initial[None])[0].data
    weights: Any = gru._flat_weights  # as nn.GRU itself passes them on
    input_weight, weight, input_bias, bias = weights
    projected = F.linear(inputs, input_weight, input_bias)
    return _Recurrence.apply(projected, weight, bias, initial.detach(), batch_sizes.tolist())


def run_step(gru: nn.GRU, inputs: th.Tensor, states: th.Tensor) -> th.Tensor:
    """Hidden states after one step, without gradients.

    :param gru: One layer
    :param inputs: Shape (k, F)
    :param states: Hidden states before, shape (k, H)
    :return: Shape (k, H)
    """
    return run_sequences(gru, inputs, th.tensor([len(inputs)]), states)


def _is_supported(inputs: th.Tensor) -> bool:
    return inputs.device.type == "cpu" and inputs.dtype == th.float32


class _Recurrence(th.autograd.Function):
    """The part of a GRU that cannot be computed for all steps at once."""

    @staticmethod
    def forward(
        ctx: Any,
        projected: th.Tensor,
        weight: th.Tensor,
        bias: th.Tensor,
        initial: th.Tensor,
        batch_sizes: list[int],
    ) -> th.Tensor:
        """See :func:`run_sequences`.

        :param projected: x Wᵢ + bᵢ of all gates, shape (B, 3H)
        :param weight: Wₕ as ``nn.GRU`` has it, shape (3H, H)
        :param bias: bₕ, shape (3H,)
        :param initial: Shape (k, H)
        :param batch_sizes: L numbers
        """
        size = weight.shape[1]
        gates = th.empty(len(projected), 4 * size)  # r, z, n, and h Wₕₙ + bₕₙ, for the way back
        hidden = th.empty(len(projected), size)
        recurrent = th.empty(batch_sizes[0], 3 * size)
        tensors = (projected, bias, recurrent, gates, hidden, initial.contiguous())
        run = _forward_few if batch_sizes[0] <= _FEW else _forward_many
        run(weight.t(), batch_sizes, *tensors)
        ctx.save_for_backward(weight, gates, _before(hidden, initial, batch_sizes))
        ctx.batch_sizes = batch_sizes
        return hidden

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Gradients of the projected inputs, the recurrent weights and the bias."""
        weight, gates, before = ctx.saved_tensors
        n_rows, size = before.shape
        d_projected = th.empty(n_rows, 3 * size)
        d_recurrent = th.empty(n_rows, 3 * size)  # of h Wₕ + bₕ
        carried = th.zeros(ctx.batch_sizes[0], size)  # of h', from the steps after
        tensors = (gradient.contiguous(), gates, before, d_projected, d_recurrent, carried)
        run = _backward_few if ctx.batch_sizes[0] <= _FEW else _backward_many
        run(weight, ctx.batch_sizes, *tensors)
        return d_projected, d_recurrent.t() @ before, d_recurrent.sum(dim=0), None, None


# Up to this many sequences a compiled loop over all steps is faster; beyond it, the time that
# torch's matrix products save is longer than the time that calling them takes.
_FEW = 4


def _forward_many(
    weight: th.Tensor,
    batch_sizes: list[int],
    projected: th.Tensor,
    bias: th.Tensor,
    recurrent: th.Tensor,
    gates: th.Tensor,
    hidden: th.Tensor,
    initial: th.Tensor,
) -> None:
    """Run through time, with torch's matrix products; see :func:`_forward_steps`."""
    x, b, u, g, h, before = map(_array, (projected, bias, recurrent, gates, hidden, initial))
    previous, first = initial, 0
    for n, states in zip(batch_sizes, hidden.split(batch_sizes), strict=True):
        end = first + n
        th.mm(previous[:n], weight, out=recurrent[:n])
        _gates(x[first:end], u, b, before, g[first:end], h[first:end])
        previous, before, first = states, h[first:end], end


def _backward_many(
    weight: th.Tensor,
    batch_sizes: list[int],
    gradient: th.Tensor,
    gates: th.Tensor,
    before: th.Tensor,
    d_projected: th.Tensor,
    d_recurrent: th.Tensor,
    carried: th.Tensor,
) -> None:
    """Run back through time, with torch's matrix products; see :func:`_backward_steps`."""
    tensors = (gradient, gates, before, d_projected, d_recurrent, carried)
    dh, g, h, dx, du, c = map(_array, tensors)
    end = len(before)
    steps = zip(batch_sizes, d_recurrent.split(batch_sizes), strict=True)
    for n, d_step in reversed(list(steps)):
        first = end - n
        _gate_gradients(dh[first:end], g[first:end], h[first:end], dx[first:end], du[first:end], c)
        carried[:n].addmm_(d_step, weight)
        end = first


def _forward_few(weight: th.Tensor, batch_sizes: list[int], *tensors: th.Tensor) -> None:
    """Run through time in one compiled loop."""
    _forward_steps(_array(weight.contiguous()), np.array(batch_sizes), *map(_array, tensors))


def _backward_few(weight: th.Tensor, batch_sizes: list[int], *tensors: th.Tensor) -> None:
    """Run back through time in one compiled loop."""
    _backward_steps(_array(weight.contiguous()), np.array(batch_sizes), *map(_array, tensors))


def _array(tensor: th.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def _before(hidden: th.Tensor, initial: th.Tensor, batch_sizes: list[int]) -> th.Tensor:
    """Hidden states before every step, shape (B, H)."""
    steps = [initial, *hidden.split(batch_sizes)]
    return th.cat([states[:n] for states, n in zip(steps, batch_sizes, strict=False)])


# A rational function in place of tanh, so that loops over it compile to vector instructions.
# Largest error about 3e-7; coefficients of the usual minimax fit (as in Eigen and XNNPACK).
@njit(cache=True, inline="always")
def _tanh(x):
    x = np.float32(7.9) if x > np.float32(7.9) else x  # in this form NaN stays NaN
    x = np.float32(-7.9) if x < np.float32(-7.9) else x
    s = x * x
    p = np.float32(-2.76076847742355e-16)
    p = p * s + np.float32(2.00018790482477e-13)
    p = p * s + np.float32(-8.60467152213735e-11)
    p = p * s + np.float32(5.12229709037114e-08)
    p = p * s + np.float32(1.48572235717979e-05)
    p = p * s + np.float32(6.37261928875436e-04)
    p = p * s + np.float32(4.89352455891786e-03)
    q = np.float32(1.19825839466702e-06)
    q = q * s + np.float32(1.18534705686654e-04)
    q = q * s + np.float32(2.26843463243900e-03)
    q = q * s + np.float32(4.89352518554385e-03)
    return x * p / q


@njit(cache=True, inline="always")
def _sigmoid(x):
    half = np.float32(0.5)
    return half * _tanh(half * x) + half


# Three short loops instead of one: with fewer arrays in each, they compile to vector instructions.
@njit(cache=True, fastmath={"contract"}, error_model="numpy", nogil=True)
def _gates(projected, recurrent, bias, before, gates, hidden):
    """One step of n sequences.

    :param projected: shape (n, 3H)
    :param recurrent: h Wₕ, shape (at least n, 3H)
    :param bias: shape (3H,)
    :param before: h, shape (at least n, H)
    :param gates: the result r, z, n and h Wₕₙ + bₕₙ, shape (n, 4H)
    :param hidden: the result h', shape (n, H)
    """
    size = hidden.shape[1]
    for i in range(len(hidden)):
        x, u, g, h, out = projected[i], recurrent[i], gates[i], before[i], hidden[i]
        for j in range(2 * size):
            g[j] = _sigmoid(x[j] + u[j] + bias[j])
        for j in range(size):
            a = u[2 * size + j] + bias[2 * size + j]
            g[2 * size + j] = _tanh(x[2 * size + j] + g[j] * a)
            g[3 * size + j] = a
        for j in range(size):
            n = g[2 * size + j]
            out[j] = n + g[size + j] * (h[j] - n)


@njit(cache=True, fastmath={"contract"}, error_model="numpy", nogil=True)
def _gate_gradients(gradient, gates, before, d_projected, d_recurrent, carried):
    """One step backward of n sequences.

    :param gradient: of h', from outside, shape (n, H)
    :param gates: what :func:`_gates` kept, shape (n, 4H)
    :param before: h, shape (n, H)
    :param d_projected: the result, shape (n, 3H)
    :param d_recurrent: the result, shape (n, 3H)
    :param carried: of h', from the steps after, and then of h by z alone, shape (at least n, H)
    """
    size = before.shape[1]
    one = np.float32(1.0)
    for i in range(len(before)):
        g, h, dx, du = gates[i], before[i], d_projected[i], d_recurrent[i]
        for j in range(size):
            r, z, n, a = g[j], g[size + j], g[2 * size + j], g[3 * size + j]
            dh = gradient[i, j] + carried[i, j]
            dn = dh * (one - z) * (one - n * n)
            dr = dn * a * r * (one - r)
            dz = dh * (h[j] - n) * z * (one - z)
            dx[j] = dr
            dx[size + j] = dz
            dx[2 * size + j] = dn
            du[j] = dr
            du[size + j] = dz
            du[2 * size + j] = dn * r
            carried[i, j] = dh * z


@njit(cache=True, nogil=True)
def _forward_steps(weight, batch_sizes, projected, bias, recurrent, gates, hidden, initial):
    """Run through time.

    :param weight: Wₕ, shape (H, 3H)
    :param batch_sizes: shape (L,)
    :param projected: x Wᵢ + bᵢ, shape (B, 3H)
    :param bias: bₕ, shape (3H,)
    :param recurrent: work space, shape (k, 3H)
    :param gates: a result, see :func:`_gates`, shape (B, 4H)
    :param hidden: the result, shape (B, H)
    :param initial: shape (k, H)
    """
    before, first = initial, 0
    for n in batch_sizes:
        end = first + n
        recurrent[:] = 0.0
        _add_product(before[:n], weight, recurrent)
        _gates(projected[first:end], recurrent, bias, before, gates[first:end], hidden[first:end])
        before, first = hidden[first:end], end


@njit(cache=True, nogil=True)
def _backward_steps(
    weight, batch_sizes, gradient, gates, before, d_projected, d_recurrent, carried
):
    """Run back through time.

    :param weight: Wₕ transposed, shape (3H, H)
    :param batch_sizes: shape (L,)
    :param gradient: of the hidden states, from outside, shape (B, H)
    :param gates: see :func:`_gates`, shape (B, 4H)
    :param before: h before every step, shape (B, H)
    :param d_projected: the result, shape (B, 3H)
    :param d_recurrent: the result, of h Wₕ + bₕ, shape (B, 3H)
    :param carried: work space, at first zero, shape (k, H)
    """
    end = len(before)
    for step in range(len(batch_sizes) - 1, -1, -1):
        first = end - batch_sizes[step]
        _gate_gradients(
            gradient[first:end],
            gates[first:end],
            before[first:end],
            d_projected[first:end],
            d_recurrent[first:end],
            carried,
        )
        _add_product(d_recurrent[first:end], weight, carried)
        end = first


@njit(cache=True, fastmath={"contract"}, nogil=True)
def _add_product(a, b, out):
    """Add the matrix product of a few rows, four summands at a time.

    :param a: shape (n, K)
    :param b: shape (K, C)
    :param out: shape (at least n, C)
    """
    whole = a.shape[1] - a.shape[1] % 4
    for i in range(len(a)):
        row = out[i]
        for k in range(0, whole, 4):
            b0, b1, b2, b3 = b[k], b[k + 1], b[k + 2], b[k + 3]
            a0, a1, a2, a3 = a[i, k], a[i, k + 1], a[i, k + 2], a[i, k + 3]
            for c in range(len(row)):
                row[c] += a0 * b0[c] + a1 * b1[c] + (a2 * b2[c] + a3 * b3[c])
        for k in range(whole, a.shape[1]):
            for c in range(len(row)):
                row[c] += a[i, k] * b[k, c]
