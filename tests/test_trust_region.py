"""TrustRegionMonitor: its numbers, that it only watches, and the epochs that it cuts short.

Two agents who walk for two steps and choose slow or fast with probability 1/2 have 16 equally
likely episodes. Sixteen worlds play each of them once, so that every mean over the worlds is exact.
"""

import itertools
import warnings

import numpy as np
import pytest
import torch as th
from conftest import TwoOnALine
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.distributions import (
    Distribution,
    make_proba_distribution,
)
from test_mappo import Recorded

from sb3_e2c import E2CMAPPO, MAPPO, TrustRegionMonitor, share_parameters
from sb3_e2c.trust_region import ActorOutputs, agent_kls, episode_ages

SMALL = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "device": "cpu", "seed": 0}
POLICY_KWARGS = {
    "MlpPolicy": {"net_arch": [8]},
    "GruPolicy": {"net_arch": [8], "gru_hidden_size": 4},
}
GAMMA = 0.5
# every sequence of two joint actions, shape (2 steps, 16 worlds, 2 agents)
EPISODES = np.array(list(itertools.product(range(2), repeat=4))).reshape(16, 2, 2).swapaxes(0, 1)
# both agents go from 1/2 to 5/8: -½ ln(1 - 4/64), as in docs/bounds.md
KL = -np.log(1 - 4 / 64) / 2


def line(n_worlds=3, backend="auto", **kwargs):
    return share_parameters(lambda: TwoOnALine(**kwargs), n_worlds, backend=backend)


def make(policy="MlpPolicy", env=None, algorithm=MAPPO, **kwargs):
    kwargs = {**SMALL, "policy_kwargs": POLICY_KWARGS[policy], **kwargs}
    return algorithm(policy, env or line(), **kwargs)


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def play_fast_with(model, probability):
    """Let every agent be fast with this probability, whatever it observes."""
    with th.no_grad():
        model.policy.action_net.weight.zero_()
        log_odds = np.log(probability / (1 - probability))
        model.policy.action_net.bias.copy_(th.tensor([0.0, log_odds]))


class Scripted(MAPPO):
    """Plays given episodes, and moves to given probabilities of being fast.

    :param plays: Joint actions of all worlds in each rollout, shape (2 steps, W, 2 agents)
    :param moves: Probabilities after each epoch of each update
    """

    def follow(self, plays, moves):
        self.plays, self.moves, self.n_rollouts = plays, iter(moves), 0
        play_fast_with(self, 0.5)
        self.policy.act = self.act_as_told
        with th.no_grad():
            for parameter in self.policy._cost_modules()[1].parameters():
                parameter.zero_()  # the cost critics say 0
        return self

    def act_as_told(self, observations, states):
        play = self.plays[min(self.n_rollouts, len(self.plays) - 1)]
        return th.as_tensor(play[self.rollout_buffer.pos].ravel()), states

    def _train_epoch(self, samples, descent, logs):
        play_fast_with(self, next(self.moves))
        logs["loss"] = logs["approx_kl"] = logs["cost_value_loss"] = [0.0]
        return True

    def train(self):
        super().train()
        self.n_rollouts += 1


def scripted(env=None, plays=(EPISODES,), moves=(5 / 8,), policy="MlpPolicy", **kwargs):
    settings = {"n_steps": 2, "n_epochs": 1, "gamma": GAMMA, "gae_lambda": 1.0, "cost_limits": 2.0}
    env = env or line(n_worlds=16, length=2, end="terminated")
    model = make(policy, env, Scripted, **{**settings, **kwargs})
    return model.follow(plays, moves)


def logged(model, n_rollouts=1, monitor=None, **kwargs):
    """The last value of every key that a monitor logs."""
    recorded = Recorded()
    callbacks = [recorded, monitor or TrustRegionMonitor(**kwargs)]
    model.learn(n_rollouts * model.n_steps * model.env.num_envs, callback=callbacks)
    prefix = "bounds/"
    return {k.removeprefix(prefix): v for k, v in recorded.values.items() if k.startswith(prefix)}


# Numbers by hand


@pytest.mark.parametrize("policy", POLICY_KWARGS)
@pytest.mark.parametrize("scope", ["team", "individual"])
@pytest.mark.parametrize("backend", ["batched", "supersuit"])
def test_a_cost_that_is_the_sum_of_the_agents_costs(policy, scope, backend):
    env = line(n_worlds=16, length=2, end="terminated", backend=backend)
    values = logged(scripted(env, policy=policy, cost_scope=scope))
    # one of two is fast in the mean: J = 1 + γ; then 2 · 5/8, that is 1/4 more in each step
    assert values["cost"] == pytest.approx(1.5)
    assert values["joint"] == pytest.approx(0.25 * 1.5)
    assert values["agent_0"] == pytest.approx(0.125 * 1.5)
    assert values["agent_1"] == pytest.approx(0.125 * 1.5)
    assert values["sum"] == pytest.approx(0.25 * 1.5)
    assert values["interaction"] == pytest.approx(0, abs=1e-6)
    # without discount, as limits have it: 2 + 2 · 1/4
    assert values["ep_cost_predicted"] == pytest.approx(2.5)


@pytest.mark.parametrize("backend", ["batched", "supersuit"])
def test_only_the_agent_who_pays_has_a_surrogate(backend):
    costs = {"agent_costs": (1.0, 0.0), "length": 2, "end": "terminated"}
    values = logged(scripted(line(16, backend, **costs)))
    assert values["agent_0"] == pytest.approx(0.125 * 1.5)
    assert values["agent_1"] == pytest.approx(0, abs=1e-6)


def test_a_cost_that_agents_cause_together_has_an_interaction():
    env = line(n_worlds=16, length=2, end="terminated", team_cost="max")
    values = logged(scripted(env))
    # P(someone is fast) is 48/64, then 55/64, and 52/64 if one agent moves alone
    assert values["cost"] == pytest.approx(0.75 * 1.5)
    assert values["joint"] == pytest.approx(7 / 64 * 1.5)
    assert values["agent_0"] == pytest.approx(4 / 64 * 1.5)
    assert values["interaction"] == pytest.approx(-1 / 64 * 1.5)


def test_individual_agents_who_report_one_cost_are_not_counted_twice():
    env = line(n_worlds=16, length=2, end="terminated", team_cost="max")
    values = logged(scripted(env, cost_scope="individual"))
    assert values["cost"] == pytest.approx(0.75)  # the mean agent is fast in every second step
    assert values["joint"] == pytest.approx(0.125 * 1.5)


def test_divergences_and_sample_size():
    values = logged(scripted())
    assert values["kl"] == pytest.approx(2 * KL)
    assert values["kl_agent_0"] == values["kl_agent_1"] == pytest.approx(KL)
    assert values["kl_max"] == pytest.approx(2 * KL)
    # joint probabilities 9, 15, 15, 25 of 64, before 16 each: (7 + 1 + 1 + 9) / 2 / 64
    assert values["tv"] == pytest.approx(9 / 64)
    # 1 / mean of q²: 4 · 256 / (81 + 225 + 225 + 625)
    assert values["sample_size"] == pytest.approx(1024 / 1156)
    assert values["unreliable"] == 0


@pytest.mark.parametrize(("max_cost", "epsilon"), [(None, 3.0), (2.0, 4.0), ([2.5], 5.0)])
def test_bounds(max_cost, epsilon):
    # without a critic |A| is the cost that follows, at most 2 (1 + γ); else c_max / (1 − γ)
    values = logged(scripted(), max_cost=max_cost)
    assert values["epsilon"] == pytest.approx(epsilon)
    predicted, sum_kl = 1.5 + 0.375, 2 * KL
    # 2γε/(1−γ)² = 4ε, and ε/(1−γ) = 2ε
    assert values["t1"] == pytest.approx(predicted + 4 * epsilon * sum_kl)
    assert values["t3"] == pytest.approx(predicted + 6 * epsilon * sum_kl)
    printed = 1.5 + 0.1875 + 8 * epsilon * sum_kl
    assert values["printed_not_a_bound"] == pytest.approx(printed)
    # c_max/(1 − γ) = 2 c_max is less than 2ε
    largest = 2 * np.ravel(2.0 if max_cost is None else max_cost).item() * np.sqrt(sum_kl / 2)
    assert values["t1b"] == pytest.approx(predicted + 4 * largest * 9 / 64)


def test_the_printed_number_is_that_of_the_agent_who_promises_most():
    values = logged(scripted(line(16, agent_costs=(1.0, 0.0), length=2, end="terminated")))
    # J = 3/4, L₁ = 0, |A| ≤ 3/2
    assert values["printed_not_a_bound"] == pytest.approx(0.75 + 8 * 1.5 * 2 * KL)


def test_the_next_rollout_shows_what_came_of_it():
    all_fast = np.ones((2, 16, 2), int)
    values = logged(scripted(plays=(EPISODES, all_fast), moves=(5 / 8, 5 / 8)), n_rollouts=2)
    assert values["change"] == pytest.approx(3.0 - 1.5)
    assert values["error"] == pytest.approx(3.0 - 1.5 - 0.375)
    # rewards 1 or 2 with equal probability, then 2: 1.5 · 1.5 and 2 · 1.5 for the mean agent
    assert values["reward_change"] == pytest.approx(0.5 * 1.5)
    assert values["reward_error"] == pytest.approx(0.5 * 1.5 - 0.125 * 1.5)
    assert values["cost"] == pytest.approx(3.0)  # of the last rollout
    assert values["joint"] == pytest.approx(0.0, abs=1e-6)


def test_the_reward_is_the_mean_agents():
    values = logged(scripted(reward_scale=10.0))
    assert values["reward"] == pytest.approx(10 * 1.5 * 1.5)
    assert values["reward_joint"] == pytest.approx(10 * 0.125 * 1.5, abs=1e-4)
    assert values["reward_sum"] == pytest.approx(10 * 0.125 * 1.5, abs=1e-4)


def test_what_a_time_limit_cut_off_is_not_counted_as_paid():
    env = line(n_worlds=16, length=2, end="truncated")
    model = scripted(env)
    with th.no_grad():
        model.policy.cost_net.bias.fill_(100.0)
    values = logged(model)
    assert values["cost"] == pytest.approx(1.5)
    assert values["reward"] == pytest.approx(1.5 * 1.5)
    assert model.rollout_buffer.costs[1].min() > 40  # the learner's rows have the bootstrap


def test_one_row_of_the_log_holds_an_updates_prediction_and_its_outcome():
    all_fast = np.ones((2, 16, 2), int)
    rows = []

    class Rows(BaseCallback):
        def _on_training_start(self):
            logger = self.model.logger
            dump = logger.dump

            def keep_then_dump(step):
                rows.append(dict(logger.name_to_value))
                dump(step)

            logger.dump = keep_then_dump

        def _on_step(self):
            return True

    model = scripted(plays=(EPISODES, all_fast), moves=(5 / 8, 5 / 8))
    model.learn(2 * 64, callback=[Rows(), TrustRegionMonitor()])
    first, second = rows
    assert "bounds/joint" not in first  # nothing has been learned yet
    assert second["bounds/cost"] == pytest.approx(1.5)
    assert second["bounds/joint"] == pytest.approx(0.375)
    assert second["bounds/change"] == pytest.approx(1.5)
    assert "bounds/change" not in model.logger.name_to_value  # the last outcome is not known
    assert model.logger.name_to_value["bounds/cost"] == pytest.approx(3.0)


# Numbers of real training, recomputed slot by slot


class Reference(BaseCallback):
    """Recomputes everything one slot and one step at a time; comes after the monitor."""

    def _on_training_start(self):
        self.updates = []

    def _on_rollout_start(self):
        if self.n_calls:
            self.updates.append(self._compare())
        self.costs, self.rewards, self.dones = [], [], []
        if self.n_calls == 0:
            self.first_ages = np.zeros(self.model.env.num_envs // 2, int)

    def _on_step(self):
        infos = self.locals["infos"]
        self.costs.append([np.ravel(info.get("cost", [])) for info in infos])
        self.rewards.append(self.locals["rewards"].copy())
        self.dones.append(self.locals["dones"][::2])
        return True

    def _on_rollout_end(self):
        self.initial = self.model.rollout_buffer.initial
        self.old = self._distributions()

    def _distributions(self):
        """Log-probabilities of both actions in every step, shape (T, S, 2)."""
        policy, buffer, steps = self.model.policy, self.model.rollout_buffer, []
        states = self.initial.actor.flatten(0, 1) if policy.recurrent else None
        with th.no_grad():
            for obs, done in zip(map(th.as_tensor, buffer.observations), buffer.dones, strict=True):
                if policy.recurrent:
                    states = policy._step(obs, states)
                    steps.append(th.log_softmax(policy.action_net(states), -1))
                    states = states * th.as_tensor(~done).repeat_interleave(2)[:, None]
                else:
                    steps.append(policy.get_distribution(obs).distribution.logits)
        return th.stack(steps).double().numpy()

    def _compare(self):
        buffer, gamma, new = self.model.rollout_buffer, self.model.gamma, self._distributions()
        costs, rewards = np.array(self.costs), np.array(self.rewards)  # (T, S, M), (T, S)
        advantages = buffer.cost_advantages.astype(float).sum(2)  # (T, W, M)
        n_worlds, total = advantages.shape[1], {"cost": 0, "joint": 0, "agent_0": 0, "reward": 0}
        mass = kl = tv = episodes = joint_max = 0
        kl_max = np.zeros(2)
        ages = self.first_ages
        for t, done in enumerate(self.dones):
            for w in range(n_worlds):
                weight, slots = gamma ** ages[w], (2 * w, 2 * w + 1)
                taken = [int(buffer.actions[t, s, 0]) for s in slots]
                ratio = [
                    np.exp(new[t, s, u] - self.old[t, s, u])
                    for s, u in zip(slots, taken, strict=True)
                ]
                episodes += ages[w] == 0
                total["cost"] += weight * sum(costs[t, s] for s in slots)
                total["reward"] += weight * np.mean([rewards[t, s] for s in slots])
                total["joint"] += weight * (ratio[0] * ratio[1] - 1) * advantages[t, w]
                total["agent_0"] += weight * (ratio[0] - 1) * advantages[t, w]
                mass += weight
                olds, news = self.old[t, slots, :], new[t, slots, :]
                kls = (np.exp(olds) * (olds - news)).sum(-1)
                kl += weight * kls.sum()
                kl_max, joint_max = np.maximum(kl_max, kls), max(joint_max, kls.sum())
                tv += weight * abs(ratio[0] * ratio[1] - 1) / 2
            ages = np.where(done, 0, ages + 1)
        self.first_ages = ages
        numbers = {name: number / episodes for name, number in total.items()} if episodes else {}
        epsilon, largest = np.abs(advantages).max((0, 1)), costs.reshape(-1, n_worlds, 2, 2).sum(2)
        span = np.minimum(2 * epsilon, largest.max((0, 1)) / (1 - gamma))
        if episodes:
            predicted, factor = numbers["cost"] + numbers["joint"], 2 * gamma / (1 - gamma) ** 2
            numbers["t1"] = predicted + factor * epsilon * kl_max.sum()
            numbers["t1b"] = predicted + factor * span * np.sqrt(joint_max / 2) * tv / mass
        return {**numbers, "kl": kl / mass, "kl_max": kl_max.sum(), "tv": tv / mass}


@pytest.mark.parametrize("policy", POLICY_KWARGS)
@pytest.mark.parametrize("scope", ["team", "individual"])
@pytest.mark.parametrize("length", [3, 4, 7], ids=["uneven", "even", "longer than half a rollout"])
def test_training_logs_what_a_loop_over_all_slots_finds(policy, scope, length):
    env = line(length=length, spread=5, n_costs=2)
    model = make(policy, env, cost_limits=[2.0, 3.0], cost_scope=scope, learning_rate=0.01)
    reference, recorded = Reference(), Recorded()
    model.learn(4 * 48, callback=[recorded, TrustRegionMonitor(min_sample_size=0.0), reference])
    reference._on_rollout_start()  # of a rollout that is not made
    expected, values = reference.updates[-1], recorded.values
    assert len(reference.updates) == 4
    for name in ("kl", "kl_max", "tv"):
        assert values[f"bounds/{name}"] == pytest.approx(expected[name], rel=1e-3)
    assert expected["kl"] > 1e-4
    assert values["bounds/reward"] == pytest.approx(expected["reward"], rel=1e-5)
    for name in ("cost", "joint", "agent_0", "t1", "t1b"):
        found = [values[f"bounds/{name}_{j}"] for j in range(2)]
        assert found == pytest.approx(expected[name].tolist(), rel=1e-3, abs=1e-5)
    before, after = (update["cost"] for update in reference.updates[-2:])
    assert values["bounds/change_1"] == pytest.approx(after[1] - before[1], abs=1e-5)


def test_ages_count_from_the_beginning_of_each_episode():
    dones = np.array([[0, 1], [0, 0], [1, 0], [0, 0]], bool)
    ages = episode_ages(dones, first=np.array([0, 5]))
    assert ages.T.tolist() == [[0, 1, 2, 0], [5, 0, 1, 2]]


# Costs: none, several


def test_without_constraints_it_watches_the_divergences_and_the_reward():
    values = logged(make(), n_rollouts=2)
    assert set(values) == {
        *("kl", "kl_agent_0", "kl_agent_1", "kl_max", "tv", "sample_size", "unreliable"),
        *("reward", "reward_joint", "reward_sum", "reward_change", "reward_error"),
    }


def test_a_second_cost_has_numbers_of_its_own():
    # the second cost is twice the first
    env = line(n_worlds=16, length=2, end="terminated", n_costs=2)
    values = logged(scripted(env, cost_limits=[2.0, 4.0]), max_cost=[2.0, 4.0])
    for name in ("cost", "joint", "agent_1", "sum", "t1", "t1b", "t3", "printed_not_a_bound"):
        assert values[f"{name}_1"] == pytest.approx(2 * values[f"{name}_0"])
    assert values["joint_0"] == pytest.approx(0.375)


def test_a_cost_without_discount_has_predictions_but_no_bounds():
    values = logged(scripted(cost_gamma=1.0))
    assert values["joint"] == pytest.approx(0.5)
    assert "t1" not in values


# KL of every kind of policy


def outputs(distribution: Distribution, raw, log_std=None):
    """What the monitor sees of a policy, and torch's distributions for comparison."""
    args = (raw,) if log_std is None else (raw, log_std)
    kind = distribution.proba_distribution(*args).distribution
    return ActorOutputs(raw, log_std, th.zeros(len(raw), 1)), kind


@pytest.mark.parametrize(
    "space",
    [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.Box(-1, 1, (2,))],
    ids=["categorical", "several categorical", "gaussian"],
)
def test_the_kl_is_torchs(space):
    generator = th.Generator().manual_seed(0)
    distribution = make_proba_distribution(space)
    size = {"Discrete": 3, "MultiDiscrete": 5, "Box": 2}[type(space).__name__]
    stds = (th.tensor([0.1, -0.5]), th.tensor([0.3, 0.0])) if size == 2 else (None, None)
    old, new = (
        outputs(distribution, th.randn(6, size, generator=generator), log_std) for log_std in stds
    )
    kinds = zip(*(k if isinstance(k, list) else [k] for k in (old[1], new[1])), strict=True)
    expected = sum(th.distributions.kl_divergence(*pair) for pair in kinds)
    expected = expected.sum(-1) if size == 2 else expected
    found = agent_kls(distribution, old[0], new[0])
    np.testing.assert_allclose(found[:, 0], expected.numpy(), rtol=1e-5)


@pytest.mark.parametrize("known", [False, True])
def test_a_policy_without_a_closed_form_has_the_sampled_kl(known):
    raw = th.zeros(2, 3) if known else None
    old = ActorOutputs(raw, None, th.zeros(2, 1))
    new = ActorOutputs(raw, None, th.log(th.tensor([[2.0], [1.0]])))
    distribution = make_proba_distribution(spaces.MultiBinary(3))
    # q − 1 − log q at 2 and at 1
    assert agent_kls(distribution, old, new).tolist() == [[pytest.approx(1 - np.log(2))], [0.0]]


# It only watches


@pytest.mark.parametrize("policy", POLICY_KWARGS)
@pytest.mark.parametrize("algorithm", [MAPPO, E2CMAPPO])
def test_it_changes_nothing_that_is_learned(policy, algorithm):
    def trained(callback):
        model = make(policy, line(length=5, spread=5), algorithm, cost_limits=2.0)
        return parameters(model.learn(6 * 48, callback=callback))

    assert trained(None).equal(trained(TrustRegionMonitor()))
    # limits that nothing exceeds: asked after every epoch, and still the same
    assert trained(None).equal(trained(TrustRegionMonitor(max_joint_kl=1e9, max_excess=1e9)))


def test_it_leaves_no_trace_in_the_model_and_can_be_saved_while_it_watches(tmp_path):
    class Save(BaseCallback):
        def _on_rollout_end(self):
            self.model.save(tmp_path / "model")

        def _on_step(self):
            return True

    model = make(cost_limits=2.0)
    model.learn(96, callback=[TrustRegionMonitor(max_joint_kl=1.0), Save()])
    assert not model.policy.action_net._forward_hooks
    assert model.stop_epochs is None
    loaded = MAPPO.load(tmp_path / "model", env=line())
    assert loaded.stop_epochs is None
    loaded.learn(48)


def test_training_that_stops_within_a_rollout_keeps_the_numbers_of_the_last_update():
    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls <= 3  # four calls: the first step of the second rollout is stored

    all_fast = np.ones((2, 16, 2), int)
    model, recorded = scripted(plays=(EPISODES, all_fast), moves=(5 / 8,)), Recorded()
    model.learn(128, callback=[recorded, TrustRegionMonitor(), Stop()])
    assert model.rollout_buffer.pos == 2
    assert recorded.values["bounds/joint"] == pytest.approx(0.375)
    assert "bounds/change" not in recorded.values


def test_one_monitor_serves_several_calls_of_learn():
    model, monitor = make(cost_limits=2.0), TrustRegionMonitor()
    first = logged(model, monitor=monitor)
    second = logged(model, monitor=monitor)
    assert "change" not in first  # one update, of which no rollout has told
    assert second["joint"] != first["joint"]


def test_a_rollout_in_which_no_episode_begins_is_said_and_has_divergences_only():
    # episodes of 20 steps, rollouts of 8: the second has the steps 8 to 15
    model = make(env=line(length=20), cost_limits=2.0)
    with pytest.warns(UserWarning, match=r"No episode begins.*n_steps") as caught:
        values = logged(model, n_rollouts=2, monitor=TrustRegionMonitor())
    assert len(caught) == 1
    assert "change" not in values
    assert values["kl"] > 0


def test_it_continues_in_the_middle_of_episodes():
    model = make(env=line(length=6), cost_limits=2.0)
    monitor = TrustRegionMonitor()
    logged(model, monitor=monitor)
    model.learn(48, callback=monitor, reset_num_timesteps=False)
    # two steps of the second episode were made in the first rollout
    assert monitor._first_ages.tolist() == [2, 2, 2]
    other = TrustRegionMonitor()
    model.learn(48, callback=other, reset_num_timesteps=False)
    assert other._first_ages.tolist() == [1, 1, 1]  # who has not seen the beginning: not 0


def test_a_small_sample_size_is_said_once():
    model = scripted(plays=(EPISODES,) * 3, moves=(0.99,) * 3)
    with pytest.warns(UserWarning, match=r"effective sample size of 0\.2.*max_joint_kl") as caught:
        values = logged(model, n_rollouts=1)
    assert len(caught) == 1
    assert values["unreliable"] == 1
    monitor = TrustRegionMonitor()
    with pytest.warns(UserWarning, match="effective sample size"):
        logged(scripted(moves=(0.99,)), monitor=monitor)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert logged(scripted(moves=(0.99,)), monitor=monitor)["unreliable"] == 1


# Epochs that it cuts short


def test_epochs_end_when_the_joint_kl_is_exceeded():
    # one agent's KL is 0.032, the joint 0.065; after the second epoch 0.23 and 0.46
    moves = (5 / 8, 0.8, 0.9)
    for limit, epochs in ((0.05, 1), (0.06, 1), (0.07, 2), (0.4, 2), (0.5, 3)):
        values = logged(scripted(n_epochs=3, moves=moves), max_joint_kl=limit, min_sample_size=0)
        assert values["epochs"] == epochs


def test_a_predicted_excess_of_the_limit_ends_the_epochs():
    # the cost of an episode is predicted to go from 2 to 2.5, and to 3 with 3/4
    moves = (5 / 8, 3 / 4, 3 / 4)
    for limit, excess, epochs in ((2.2, 0.25, 1), (2.2, 0.35, 2), (2.5, 0.0, 2), (3.0, 0.0, 3)):
        model = scripted(n_epochs=3, moves=moves, cost_limits=limit)
        assert logged(model, max_excess=excess + 1e-6)["epochs"] == epochs


def test_a_step_toward_the_limit_is_never_cut_short():
    model = scripted(n_epochs=3, moves=(3 / 8, 3 / 8, 3 / 8), cost_limits=0.5)
    assert logged(model, max_excess=0.0)["epochs"] == 3


def test_any_of_several_limits_ends_the_epochs():
    env = line(n_worlds=16, length=2, end="terminated", n_costs=2)
    for limits, epochs in (([9.0, 9.0], 2), ([9.0, 4.9], 1), ([2.4, 9.0], 1)):
        model = scripted(env, n_epochs=2, moves=(5 / 8, 5 / 8), cost_limits=limits)
        assert logged(model, max_excess=0.0)["epochs"] == epochs


def test_real_training_stops_after_the_first_epoch_that_moves(capsys):
    model = make(cost_limits=2.0, n_epochs=5)
    monitor = TrustRegionMonitor(max_joint_kl=0.0, verbose=1)
    values = logged(model, n_rollouts=3, monitor=monitor)
    assert values["epochs"] == 1
    assert model._n_updates == 3
    assert "no more epochs after 1, joint KL" in capsys.readouterr().out


# Mistakes


@pytest.mark.parametrize("name", ["max_cost", "min_sample_size", "max_joint_kl", "max_excess"])
@pytest.mark.parametrize("value", [-1, "much", True, np.inf, np.nan])
def test_an_argument_that_is_no_amount_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is .* expected a number of at least 0"):
        TrustRegionMonitor(**{name: value})


def test_a_model_without_teams_is_refused():
    with pytest.raises(TypeError, match="PPO does not keep its rollouts by team"):
        TrustRegionMonitor().init_callback(PPO("MlpPolicy", "CartPole-v1", device="cpu"))


def test_a_limit_on_the_excess_needs_a_limit():
    with pytest.raises(ValueError, match=r"max_excess is 1.*no cost limit"):
        TrustRegionMonitor(max_excess=1.0).init_callback(make())


def test_largest_costs_must_fit_the_limits():
    with pytest.raises(ValueError, match=r"max_cost is \[1.*there are 1 cost limits"):
        TrustRegionMonitor(max_cost=[1.0, 2.0]).init_callback(make(cost_limits=2.0))


def test_a_yaml_can_name_it(tmp_path):
    from sb3_e2c.zoo.train import train

    yaml = tmp_path / "watched.yml"
    monitor = "sb3_e2c.TrustRegionMonitor: {max_cost: 6.0}"
    yaml.write_text(f"MultiRover-6-3-v0:\n  n_envs: 1\n  callback:\n  - {monitor}\n")
    flags = "--algo e2c_t --env MultiRover-6-3-v0 -n 960 --eval-freq -1 --verbose 0 --seed 1"
    folder = train([*flags.split(), "--conf-file", str(yaml), "-f", str(tmp_path)])
    header = (folder / "progress.csv").read_text()
    assert "bounds/joint" in header
    assert "bounds/agent_5" in header


def test_an_interrupted_training_leaves_nothing_behind():
    model = MAPPO("MlpPolicy", share_parameters(TwoOnALine, n_worlds=2), n_steps=8, batch_size=16)

    def interrupt(local, _):
        if local["self"].num_timesteps > 40:
            raise KeyboardInterrupt
        return True

    monitor = TrustRegionMonitor(max_joint_kl=1.0)
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callback=[monitor, ConvertCallback(interrupt)])
    model.learn(64)
    assert model.stop_epochs is None
