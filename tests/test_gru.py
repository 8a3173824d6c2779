"""The fast GRU against ``torch.nn.GRU``."""

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.nn.utils.rnn import PackedSequence

from sb3_e2c.gru import _tanh, run_sequences, run_step

UNEVEN = th.tensor([7, 7, 5, 1, 1])
EVEN = th.tensor([6, 6, 6])
FEW = th.tensor([3, 3, 2, 1])  # compiled as a whole


def problem(batch_sizes, size=17, n_inputs=9):
    th.manual_seed(0)
    gru = nn.GRU(n_inputs, size)
    for parameter in gru.parameters():
        nn.init.normal_(parameter, std=0.5)
    inputs = th.randn(int(batch_sizes.sum()), n_inputs, requires_grad=True)
    return gru, inputs, th.randn(int(batch_sizes[0]), size)


def with_gradients(output, gru, inputs):
    weights = th.linspace(-1, 1, output.numel()).view_as(output)
    return [output, *th.autograd.grad((output * weights).sum(), [inputs, *gru.parameters()])]


@pytest.mark.parametrize("batch_sizes", [UNEVEN, EVEN, FEW, th.tensor([9])], ids=str)
def test_states_and_gradients_are_those_of_torch(batch_sizes):
    gru, inputs, initial = problem(batch_sizes)
    ours = with_gradients(run_sequences(gru, inputs, batch_sizes, initial), gru, inputs)
    packed = PackedSequence(inputs, batch_sizes)
    theirs = with_gradients(gru(packed, initial[None])[0].data, gru, inputs)
    assert len(ours) == 6  # output, inputs, two weights, two biases
    for one, other in zip(ours, theirs, strict=True):
        th.testing.assert_close(one, other, rtol=2e-6, atol=2e-6 * other.abs().max().item())


def test_a_step_is_a_sequence_of_one():
    gru, inputs, initial = problem(th.tensor([5]))
    expected = gru(inputs[None], initial[None])[0][0]
    th.testing.assert_close(run_step(gru, inputs, initial), expected, rtol=1e-5, atol=1e-6)


def test_double_precision_falls_back_on_torch():
    gru, inputs, initial = problem(UNEVEN)
    gru, inputs, initial = gru.double(), inputs.detach().double(), initial.double()
    expected = gru(PackedSequence(inputs, UNEVEN), initial[None])[0].data
    assert run_sequences(gru, inputs, UNEVEN, initial).equal(expected)


def test_the_rational_tanh_is_accurate_everywhere():
    x = np.concatenate([np.linspace(-12, 12, 20001), [0.0, 1e-20, -1e30, 1e30]]).astype(np.float32)
    approximate = np.array([_tanh.py_func(each) for each in x])
    assert np.abs(approximate - np.tanh(x.astype(np.float64))).max() < 5e-7
    assert np.isnan(_tanh(np.float32(np.nan)))
