"""A GRU over sequences of uneven lengths, several times faster on a CPU than ``torch.nn.GRU``.

torch runs a dozen small operations for every step, and as many backward. Here one matrix product
projects the inputs of all steps, and every step is one matrix product and one compiled loop over
the gates; the gradient of the recurrent weights is a single product at the end.

Shapes: B steps of k sequences in the order of ``PackedSequence``, F inputs, H hidden units. Gates
are those of ``torch.nn.GRU``, in its order r, z, n:

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
        n_rows, size = len(projected), weight.shape[1]
        # what the backward pass needs: r, z, n, and h Wₕₙ + bₕₙ
        gates = th.empty(n_rows, 4 * size)
        hidden = th.empty(n_rows, size)
        before = th.empty(n_rows, size)  # h of the step before, for every row
        recurrent = th.empty(batch_sizes[0], 3 * size)
        transposed = weight.t()
        x, b, g, h, u = (_array(each) for each in (projected, bias, gates, hidden, recurrent))
        first, previous = 0, initial
        for n in batch_sizes:
            end = first + n
            th.mm(previous[:n], transposed, out=recurrent[:n])
            before[first:end] = previous[:n]
            _gates(x[first:end], u[:n], b, _array(previous), g[first:end], h[first:end])
            first, previous = end, hidden[first:end]
        ctx.save_for_backward(weight, gates, before)
        ctx.batch_sizes = batch_sizes
        return hidden

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Gradients of the projected inputs, the recurrent weights and the bias."""
        weight, gates, before = ctx.saved_tensors
        n_rows, size = before.shape
        d_projected = th.empty(n_rows, 3 * size)
        d_recurrent = th.empty(n_rows, 3 * size)
        carried = th.zeros(ctx.batch_sizes[0], size)  # from the steps after
        product = th.empty(ctx.batch_sizes[0], size)
        arrays = (gradient.contiguous(), gates, before, d_projected, d_recurrent)
        dh, g, hp, dx, du = (_array(each) for each in arrays)
        c, end = _array(carried), n_rows
        for n in reversed(ctx.batch_sizes):
            first = end - n
            _gate_gradients(
                dh[first:end], g[first:end], hp[first:end], dx[first:end], du[first:end], c
            )
            th.mm(d_recurrent[first:end], weight, out=product[:n])
            carried[:n] += product[:n]
            end = first
        return d_projected, d_recurrent.t() @ before, d_recurrent.sum(dim=0), None, None


def _array(tensor: th.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


# A rational function in place of tanh: its loops compile to vector instructions. Largest error
# about 3e-7; coefficients of the usual minimax fit (as in Eigen and XNNPACK).
@njit(cache=True, inline="always")
def _tanh(x):
    x = min(max(x, np.float32(-7.9)), np.float32(7.9))
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


@njit(cache=True, fastmath={"contract"}, error_model="numpy", nogil=True)
def _gates(projected, recurrent, bias, previous, gates, hidden):
    """One step of n sequences.

    :param projected: shape (n, 3H)
    :param recurrent: h Wₕ, shape (n, 3H)
    :param bias: shape (3H,)
    :param previous: h, shape (at least n, H)
    :param gates: the result r, z, n and h Wₕₙ + bₕₙ, shape (n, 4H)
    :param hidden: the result h', shape (n, H)
    """
    size = hidden.shape[1]
    for i in range(len(hidden)):
        x, u, g, h, out = projected[i], recurrent[i], gates[i], previous[i], hidden[i]
        for j in range(size):
            r = _sigmoid(x[j] + u[j] + bias[j])
            z = _sigmoid(x[size + j] + u[size + j] + bias[size + j])
            a = u[2 * size + j] + bias[2 * size + j]
            n = _tanh(x[2 * size + j] + r * a)
            g[j] = r
            g[size + j] = z
            g[2 * size + j] = n
            g[3 * size + j] = a
            out[j] = n + z * (h[j] - n)


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
