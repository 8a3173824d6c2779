"""Extreme numbers: what is learned is finite, or the run stops with a message; never silent NaN."""

import math
import re

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

from sb3_e2c import (
    E2CMAPPO,
    MAPPO,
    GradientMultipliers,
    OEMRewardCallback,
    PIDMultipliers,
    share_parameters,
)
from sb3_e2c.descent import Descent
from sb3_e2c.entropy import NearestNeighbor, VisitCount
from sb3_e2c.losses import normalize

each_policy = pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])


class Numbers(ParallelEnv):
    """Agents that observe, earn and cost given numbers, times a random factor from -1 to 1.

    :param n_agents: N
    :param n_costs: M
    :param length: steps of an episode
    :param observation: largest number observed
    :param reward: largest reward
    :param cost: largest cost
    :param constant: whether the random factor is 1
    :param dtype: of the observations
    """

    def __init__(
        self, n_agents=2, n_costs=1, length=4, observation=1.0, reward=1.0, cost=1.0,
        constant=False, dtype=np.float32,
    ):  # fmt: skip
        self.possible_agents = [f"agent_{number}" for number in range(n_agents)]
        self.agents, self.metadata, self.render_mode = self.possible_agents, {}, None
        self.n_costs, self.length, self.dtype, self.constant = n_costs, length, dtype, constant
        self.largest = (observation, reward, cost)
        self.rng = np.random.default_rng(0)

    def observation_space(self, agent):
        high = 255 if self.dtype == np.uint8 else np.inf
        return spaces.Box(0 if high == 255 else -np.inf, high, (3,), self.dtype)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def draw(self, largest, *size):
        return largest * (np.ones(size) if self.constant else self.rng.uniform(-1, 1, size))

    def observe(self):
        rows = np.abs(self.draw(self.largest[0], len(self.agents), 3)).astype(self.dtype)
        return dict(zip(self.agents, rows, strict=True))

    def reset(self, seed=None, options=None):
        self.t = 0
        return self.observe(), {}

    def step(self, actions):
        self.t += 1
        over = dict.fromkeys(self.agents, self.t == self.length)
        rewards = self.draw(self.largest[1], len(self.agents))
        infos = {}
        for agent in self.agents:
            costs = np.abs(self.draw(self.largest[2], self.n_costs))
            infos[agent] = {"cost": costs.tolist()} if self.n_costs else {}
        no = dict.fromkeys(self.agents, False)
        return self.observe(), dict(zip(self.agents, rewards, strict=True)), no, over, infos


def make(algorithm=MAPPO, policy="MlpPolicy", env=None, **kwargs):
    env = share_parameters(lambda: Numbers(**(env or {})), 2)
    settings = {"n_steps": 8, "batch_size": 128, "n_epochs": 2, "seed": 0, "device": "cpu"}
    return algorithm(policy, env, **{**settings, **kwargs})


def is_finite(model):
    learned = [*model.policy.state_dict().values(), model.multipliers.values]
    return all(th.isfinite(tensor).all() for tensor in learned)


def flat(model):
    return th.nn.utils.parameters_to_vector(model.policy.parameters())


def learn_or_stop(model, n_updates=3):
    """Learn; if it stops instead, then with a message. The model is finite in any case.

    :return: the message, "" if it learned
    """
    before = flat(model)
    message = ""
    try:
        model.learn(n_updates * model.n_steps * model.n_envs)
    except ValueError as error:
        message = str(error)
    assert is_finite(model)
    assert message or not flat(model).equal(before)
    assert not message or re.search("Lower learning_rate|[sS]cale", message)
    return message


LIMITS = {"cost_limits": 1.0}


@each_policy
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("size", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_rewards_and_costs_of_any_ordinary_size_are_learned_from(policy, size, normalized):
    env = {"reward": size, "cost": size}
    model = make(policy=policy, env=env, normalize_values=normalized, **LIMITS)
    assert learn_or_stop(model) == ""


@pytest.mark.parametrize("size", [1e18, 1e25, 1e38])
@pytest.mark.parametrize("quantity", ["reward", "cost", "observation"])
@pytest.mark.parametrize("normalized", [False, True])
def test_numbers_at_the_end_of_float32_are_learned_from_or_stop_the_run(quantity, size, normalized):
    learn_or_stop(make(env={quantity: size}, normalize_values=normalized, **LIMITS))


@each_policy
def test_observations_of_1e30_are_learned_from_or_stop_the_run(policy):
    learn_or_stop(make(policy=policy, env={"observation": 1e30}, **LIMITS))


@each_policy
@pytest.mark.parametrize(
    "env",
    [
        {"constant": True},
        {"constant": True, "reward": 0.0, "cost": 0.0},
        {"length": 1},
        {"n_agents": 1, "length": 1, "constant": True},
        {"n_agents": 64, "n_costs": 16},
        {"dtype": np.float64},
        {"dtype": np.float64, "observation": 1e12},
        {"dtype": np.uint8, "observation": 255},
    ],
    ids=str,
)
def test_odd_worlds_are_learned_from(policy, env):
    limits = [0.0, *[math.inf] * (env.get("n_costs", 1) - 1)]
    for scope in ("team", "individual"):
        model = make(
            policy=policy, env=env, cost_limits=limits, cost_scope=scope, normalize_values=True
        )
        assert learn_or_stop(model, n_updates=2) == ""


@each_policy
def test_a_minibatch_may_be_one_step_of_one_agent(policy):
    env = {"n_agents": 1, "length": 1}
    model = make(policy=policy, env=env, batch_size=1, n_steps=2, **LIMITS)
    assert learn_or_stop(model) == ""


@pytest.mark.parametrize("limit", [0.0, math.inf])
@pytest.mark.parametrize("gain", [0.0, 0.05])
@pytest.mark.parametrize("kind", [GradientMultipliers, PIDMultipliers])
def test_limits_of_zero_and_infinity_with_any_gain(kind, gain, limit):
    names = ["learning_rate"] if kind is GradientMultipliers else ["kp", "ki", "kd"]
    kwargs = {**dict.fromkeys(names, gain), "initial": 0.5}
    model = make(cost_limits=limit, multipliers_class=kind, multipliers_kwargs=kwargs)
    assert learn_or_stop(model) == ""
    values = model.multipliers.values
    if gain == 0 and kind is GradientMultipliers:
        assert values.item() == 0.5  # a fixed price
    elif limit == math.inf and gain:
        assert values.item() == 0.0
    else:
        assert values.item() >= 0.5


def test_a_gain_of_zero_is_a_fixed_price_also_under_an_infinite_limit():
    for multipliers in (
        GradientMultipliers((1, 1), learning_rate=0.0, initial=2.0),
        PIDMultipliers((1, 1), kp=0.0, ki=0.0, kd=0.0, initial=2.0),
    ):
        for _ in range(2):
            multipliers.update(th.tensor([[-math.inf]]))
            assert multipliers.values.tolist() == [[2.0]]


@pytest.mark.parametrize("initial", [1e6, 1e30])
def test_a_huge_multiplier_still_teaches_safety(initial):
    model = make(multipliers_kwargs={"initial": initial}, n_epochs=1, **LIMITS)
    model._setup_learn(32)
    assert learn_or_stop(model) == ""
    # the policy is moved by the costs alone, whose advantages are about 1e30 large
    actor = model.policy.action_net.weight
    assert actor.grad.abs().max() > 0


def test_advantages_whose_squares_overflow_are_normalized():
    small = th.tensor([1.0, 2.0, 3.0, 6.0])
    assert th.allclose(normalize(1e30 * small), normalize(small))
    assert normalize(th.full((4,), 3e38)).tolist() == [0.0] * 4
    assert normalize(th.zeros(4)).tolist() == [0.0] * 4
    assert not th.isfinite(normalize(th.tensor([1.0, math.inf]))).all()  # the loss check stops it


@pytest.mark.parametrize("advantage", [0.0, 1000.0])
def test_equal_advantages_move_no_actor(advantage):
    assert normalize(th.full((8, 2), advantage)).abs().max() == 0.0


def test_gradients_that_are_not_finite_stop_the_run_before_the_step():
    model = make(**LIMITS)
    model._setup_learn(32)
    before = flat(model)
    with Descent(model.policy, 1) as descent:
        descent._passes[0].gradient[3] = math.nan
        message = r"size of the gradients is nan after .* Lower learning"
        with pytest.raises(ValueError, match=message):
            model._gradient_step(descent, 1.0)
    assert flat(model).equal(before)


def test_a_parameter_that_overflows_in_the_last_step_stops_the_run():
    model = make(n_epochs=1, learning_rate=1e39)
    with pytest.raises(ValueError, match=r"is not finite after 32 agent steps; .* Lower learn"):
        model.learn(32)


def test_a_multiplier_that_overflows_is_explained():
    kwargs = {"learning_rate": 1e30, "initial": 1.0}
    model = make(env={"cost": 1e12}, multipliers_kwargs=kwargs, **LIMITS)
    with pytest.raises(ValueError, match=r"the multipliers are \[\[inf\]\] after costs of"):
        model.learn(96)


ESTIMATORS = {
    "visits": VisitCount(),
    "visits of level 4": VisitCount(quantization=4, high=1.0),
    "neighbors": NearestNeighbor(2),
}


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("size", [1e-38, 1e-12, 1e12, 1e18, 1e30, 3e38])
def test_bonuses_of_extreme_observations_are_finite_or_explained(name, size):
    model = make(E2CMAPPO, env={"observation": size}, oem_kwargs={"estimator": ESTIMATORS[name]})
    message = learn_or_stop(model, n_updates=1)
    assert message == "" or (size > 1e18 and re.search("bonus of slot|diverged|the loss", message))


def test_a_bonus_that_is_not_finite_is_stopped_in_any_algorithm():
    env = share_parameters(lambda: Numbers(observation=1e30), 2)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=16, seed=0, device="cpu")
    with pytest.raises(
        ValueError, match=r"NearestNeighbor bonus of slot 0 is inf, .* VecNormalize"
    ):
        model.learn(32, callback=OEMRewardCallback("nearest_neighbor", {"k": 1}))


needs_cuda = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a CUDA device")


@each_policy
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_cuda)])
def test_the_first_update_on_another_device_is_that_on_the_cpu(policy, device):
    """Actions are drawn by the device's own generator, so the first model's are played again."""
    played = []
    models = []
    for each in ("cpu", device):
        model = make(policy=policy, n_epochs=1, normalize_values=True, device=each, **LIMITS)
        start = flat(model).cpu()
        model.policy.act = playing(model.policy.act, played, again=bool(models))
        models.append(model.learn(32))
    on_cpu, on_device = (flat(model).detach().cpu() for model in models)
    assert (on_cpu - start).abs().max() > 1e-5
    th.testing.assert_close(on_device, on_cpu, rtol=0.0, atol=1e-5)
    th.testing.assert_close(
        models[1].multipliers.values.cpu(), models[0].multipliers.values, rtol=0.0, atol=1e-5
    )


def playing(act, played, again):
    """``policy.act`` that notes its actions, or takes those that were noted."""

    def act_so(observations, states):
        actions, states = act(observations, states)
        if again:
            return played.pop(0).to(actions), states
        played.append(actions.cpu())
        return actions, states

    return act_so
