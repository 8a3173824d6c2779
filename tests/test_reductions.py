"""MAPPO reduces to what is known: PPO for one agent, MAPPO for lambda 0, team = individual."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_e2c import MAPPO
from sb3_e2c.policies import TeamPolicy

SETTINGS = {"n_steps": 64, "batch_size": 16, "n_epochs": 3, "gamma": 0.9, "seed": 3}


class ActionCost(gym.Wrapper):
    """Reports a cost of 1 whenever the action is positive."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "cost": float(np.sum(action) > 0)}


def single_agent(env_id="CartPole-v1", max_steps=20):
    """One world of one agent whose episodes end by falling as well as by time."""
    env = gym.make(env_id).unwrapped
    return DummyVecEnv([lambda: Monitor(ActionCost(TimeLimit(env, max_steps)))])


def learned(algorithm, env, policy="MlpPolicy", **kwargs):
    model = algorithm(policy, env, device="cpu", **{**SETTINGS, **kwargs})
    return model.learn(64 * 4)


def assert_same_parameters(first, second, rtol=0.0, atol=0.0):
    ours, theirs = first.policy.state_dict(), second.policy.state_dict()
    compared = [name for name in theirs if name in ours and "cost" not in name]
    assert {"action_net.weight", "value_net.weight"} <= set(compared)
    for name in compared:
        difference = f"{name} differs".__add__
        th.testing.assert_close(ours[name], theirs[name], rtol=rtol, atol=atol, msg=difference)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"ent_coef": 0.01, "clip_range_vf": 0.2, "vf_coef": 1.0},
        {"target_kl": 0.003, "normalize_advantage": False},
        {"learning_rate": lambda progress: 1e-3 * progress, "clip_range": lambda p: 0.1 + 0.1 * p},
    ],
)
def test_one_agent_without_costs_learns_exactly_like_ppo(env_id, options):
    # Same seed: same initial weights, same actions, same minibatches; only the order of float
    # operations differs (ours evaluates the critic once for the whole rollout).
    ours = learned(MAPPO, single_agent(env_id), **options)
    ppo = learned(PPO, single_agent(env_id), **options)
    assert ours._n_updates == ppo._n_updates
    assert_same_parameters(ours, ppo, rtol=1e-4, atol=1e-5)


def test_the_comparison_with_ppo_can_fail():
    ours = learned(MAPPO, single_agent(), gae_lambda=0.9)
    ppo = learned(PPO, single_agent())
    with pytest.raises(AssertionError, match="differs"):
        assert_same_parameters(ours, ppo, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
@pytest.mark.parametrize("scope", ["team", "individual"])
def test_with_lambda_zero_it_is_mappo_bit_for_bit(scope, policy):
    constrained = learned(MAPPO, single_agent(), policy, cost_limits=np.inf, cost_scope=scope)
    assert constrained.multipliers.values.item() == 0.0
    assert_same_parameters(constrained, learned(MAPPO, single_agent(), policy))


@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
def test_for_one_agent_team_and_individual_constraints_are_the_same(policy):
    team, individual = (
        learned(MAPPO, single_agent(), policy, cost_limits=2.0, cost_scope=scope)
        for scope in ("team", "individual")
    )
    assert team.multipliers.values.item() == individual.multipliers.values.item() > 0
    assert_same_parameters(team, individual)
    ours, theirs = team.policy.state_dict(), individual.policy.state_dict()
    assert all(ours[name].equal(theirs[name]) for name in theirs)  # the cost critics, too


@pytest.mark.parametrize(
    "space",
    [gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Discrete(3), gym.spaces.MultiDiscrete([2, 3])],
    ids=["continuous", "discrete", "several discrete"],
)
def test_actions_are_rated_as_by_stable_baselines3_bit_for_bit(space):
    # ours leaves out the checks of torch's distributions
    observations = gym.spaces.Box(-1.0, 1.0, (4,))
    policy = TeamPolicy(observations, space, lambda _: 1e-3)
    latent = th.randn(50, 64, generator=th.Generator().manual_seed(0))
    space.seed(0)
    actions = th.as_tensor(np.array([space.sample() for _ in range(50)]))
    log_prob, entropy = policy._rate(latent, actions)
    distribution = policy._get_action_dist_from_latent(latent)
    assert log_prob.equal(distribution.log_prob(actions))
    assert entropy.equal(distribution.entropy())
