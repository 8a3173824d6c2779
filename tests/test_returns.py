"""Advantages by hand, and against Stable-Baselines3 (Eq. 5)."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_e2c.returns import gae

NO_END = np.zeros((3, 1), bool)


def column(*numbers):
    return np.array(numbers, dtype=np.float32)[:, None]


def test_with_lambda_zero_an_advantage_is_the_one_step_error():
    # δ = r + 0.5 V' − V: 1 + 0.5·2 − 0, 0 + 0.5·4 − 2, 2 + 0.5·6 − 4
    advantages = gae(column(1, 0, 2), column(0, 2, 4), np.array([6.0]), NO_END, 0.5, 0.0)
    np.testing.assert_allclose(advantages[:, 0], [2.0, 0.0, 1.0])


def test_with_lambda_one_it_is_the_discounted_return_minus_the_value():
    # returns from the back: 2 + 0.5·6 = 5, 0 + 0.5·5 = 2.5, 1 + 0.5·2.5 = 2.25
    advantages = gae(column(1, 0, 2), column(0, 2, 4), np.array([6.0]), NO_END, 0.5, 1.0)
    np.testing.assert_allclose(advantages[:, 0], [2.25, 0.5, 1.0])


def test_nothing_flows_back_over_the_end_of_an_episode():
    dones = np.array([[False], [True], [False]])
    advantages = gae(column(1, 0, 2), column(0, 2, 4), np.array([6.0]), dones, 0.5, 1.0)
    # the last step belongs to the next episode: 0 − 2 at the end, 1 + 0.5·0 − 0 before it
    np.testing.assert_allclose(advantages[:, 0], [1.0, -2.0, 1.0])


@pytest.mark.parametrize("gae_lambda", [0.0, 0.95, 1.0])
def test_it_equals_stable_baselines3_on_random_rollouts(gae_lambda):
    rng = np.random.default_rng(0)
    box = spaces.Box(-1, 1, (1,), np.float32)
    buffer = RolloutBuffer(50, box, box, "cpu", gae_lambda, 0.9, n_envs=4)
    buffer.rewards, buffer.values = rng.normal(size=(2, 50, 4)).astype(np.float32)
    starts = rng.random((51, 4)) < 0.1
    buffer.episode_starts = starts[:50].astype(np.float32)
    last = rng.normal(size=4).astype(np.float32)
    buffer.compute_returns_and_advantage(th.as_tensor(last), starts[50])
    ours = gae(buffer.rewards, buffer.values, last, starts[1:], 0.9, gae_lambda)
    np.testing.assert_allclose(ours, buffer.advantages, rtol=1e-5, atol=1e-6)


def test_costs_of_several_constraints_are_discounted_side_by_side():
    rng = np.random.default_rng(1)
    costs, values = rng.random((2, 6, 2, 3, 2))  # T, W, K, M
    last, dones = rng.random((2, 3, 2)), rng.random((6, 2, 1, 1)) < 0.3
    together = gae(costs, values, last, dones, 0.9, 0.95)
    alone = gae(costs[:, 1, 2, 1], values[:, 1, 2, 1], last[1, 2, 1], dones[:, 1, 0, 0], 0.9, 0.95)
    np.testing.assert_allclose(together[:, 1, 2, 1], alone)
