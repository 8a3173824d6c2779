"""MAPPO and E2CMAPPO on two agents on a line (Alg. 2)."""

import zipfile

import numpy as np
import pytest
import torch as th
from conftest import TwoOnALine
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_e2c import (
    E2CMAPPO,
    MAPPO,
    OEMRewardCallback,
    PIDMultipliers,
    VisitCount,
    evaluate_team,
    share_parameters,
)

SMALL = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "device": "cpu", "seed": 0}
DIMINISHING = (4.0, 3.0, 2.0, 1.0)


def line(n_worlds=2, backend="auto", **kwargs):
    return share_parameters(lambda: TwoOnALine(**kwargs), n_worlds, backend=backend)


def with_spaces(observation_space=None, action_space=None):
    """The same task, whose agents claim to see or do something else."""

    class Claims(TwoOnALine):
        batched = None

        def observation_space(self, agent):
            return observation_space or super().observation_space(agent)

        def action_space(self, agent):
            return action_space or super().action_space(agent)

        def reset(self, seed=None, options=None):
            seen, infos = super().reset(seed, options)
            return seen if observation_space is None else {
                agent: observation_space.sample() for agent in seen
            }, infos

    return share_parameters(Claims, 2)


def make(algorithm=MAPPO, env=None, **kwargs):
    return algorithm("MlpPolicy", env or line(), **{**SMALL, **kwargs})


def all_fast(model):
    """Bias the policy so far that every agent always chooses 1, fast."""
    with th.no_grad():
        model.policy.action_net.bias.copy_(th.tensor([-100.0, 100.0]))
    return model


def collect(model):
    """One rollout, without learning from it."""
    _, callback = model._setup_learn(32)
    callback.on_training_start({}, {})
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


class Recorded(BaseCallback):
    """Keeps the last value of every logger key, and the locals of the last step."""

    def _on_training_start(self):
        self.values = {}
        logger: Logger = self.model.logger
        record = logger.record

        def spy(key, value, exclude=None):
            self.values[key] = value
            record(key, value, exclude)

        logger.record = spy

    def _on_step(self):
        self.step = dict(self.locals)
        return True


class TestShapes:
    def test_the_reward_critic_has_an_output_for_every_agent_and_sees_all_of_them(self):
        policy = make().policy
        assert policy.mlp_extractor.value_net[0].in_features == 2 * 3
        assert policy.value_net.out_features == 2
        assert policy.mlp_extractor.policy_net[0].in_features == 3

    @pytest.mark.parametrize(("scope", "width"), [("team", 2 * 3), ("individual", 3)])
    def test_a_team_cost_critic_is_joint_and_an_individual_one_is_local(self, scope, width):
        model = make(env=line(n_costs=3), cost_limits=[1, 2, 3], cost_scope=scope)
        assert model.policy.cost_extractor[0].in_features == width
        assert model.policy.cost_net.out_features == 3
        parties = 1 if scope == "team" else 2
        assert model.multipliers.values.shape == (parties, 3)
        model.learn(32)
        assert model.rollout_buffer.cost_advantages.shape == (8, 2, parties, 3)

    def test_only_critics_see_the_extra_state_and_the_run_says_so(self, capsys):
        model = make(env=line(critic_state=True), verbose=1).learn(32)
        assert "and 1 numbers of info['critic_state']" in capsys.readouterr().out
        policy = model.policy
        assert policy.mlp_extractor.value_net[0].in_features == 2 * 3 + 1
        assert policy.mlp_extractor.policy_net[0].in_features == 3

    def test_the_extra_state_of_a_step_is_that_of_its_observation(self):
        model = make(env=line(length=4, critic_state=True))
        model.learn(32)
        # t / length before each of 8 steps, the fifth begins the next episode
        expected = [0, 0.25, 0.5, 0.75] * 2
        assert model.rollout_buffer.critic_states[:, 0, 0].tolist() == expected

    def test_values_without_the_critics_extra_state_are_refused(self):
        model = make(env=line(critic_state=True))
        with pytest.raises(ValueError, match=r"see 1 numbers of info\['critic_state'\]"):
            model.policy.predict_values(th.zeros(2, 3))

    @pytest.mark.parametrize(
        "space",
        [
            spaces.Box(-1.0, 1.0, (2,)),
            spaces.Discrete(2),
            spaces.MultiDiscrete([2, 3]),
        ],
        ids=["Box", "Discrete", "MultiDiscrete"],
    )
    def test_actions_may_be_continuous_discrete_or_several(self, space):
        class Any(TwoOnALine):
            batched = None

            def action_space(self, agent):
                return space

            def step(self, actions):
                assert all(space.contains(action) for action in actions.values())
                return super().step({a: int(np.sum(u) > 0) for a, u in actions.items()})

        model = make(env=share_parameters(Any, 2), cost_limits=1.0).learn(64)
        action, state = model.predict(np.zeros(3, np.float32))
        assert space.contains(action if action.shape else int(action))
        assert state is None

    @pytest.mark.parametrize(
        "space", [spaces.Discrete(2, start=1), spaces.MultiDiscrete([2, 3], start=[0, 1])]
    )
    def test_numbered_actions_that_begin_elsewhere_are_refused(self, space):
        with pytest.raises(ValueError, match=r"action space is .*; expected numbers from 0 on"):
            make(env=with_spaces(action_space=space))

    @pytest.mark.parametrize(
        ("space", "message"),
        [
            (spaces.Box(0, 3, (2,), np.int32), "expected floating-point numbers"),
            (spaces.Box(-1.0, 1.0, ()), "at least one dimension"),
            (spaces.MultiDiscrete([[2, 3], [2, 3]]), "expected one dimension"),
        ],
        ids=["integers", "scalar", "table"],
    )
    @pytest.mark.filterwarnings("ignore:.*multi-dimensional MultiDiscrete")
    def test_actions_of_another_shape_or_type_are_refused(self, space, message):
        with pytest.raises(ValueError, match=message):
            make(env=with_spaces(action_space=space))

    def test_observations_that_the_networks_cannot_read_are_refused(self):
        numbers = spaces.Discrete(3, start=1)
        with pytest.raises(ValueError, match=r"observation space is .*; expected numbers from 0"):
            make(env=with_spaces(observation_space=numbers))
        with pytest.raises(ValueError, match="expected vectors, images or numbers"):
            make(env=with_spaces(observation_space=spaces.Dict(x=spaces.Box(0.0, 1.0, (2,)))))
        with pytest.raises(ValueError, match=r"policy is 'CnnPolicy'; expected one of \['Gru"):
            MAPPO("CnnPolicy", line())

    def test_hidden_sizes_can_differ_between_actor_and_critics(self):
        arch = {"pi": [8], "vf": [16, 16], "cvf": [4]}
        policy = make(cost_limits=1.0, policy_kwargs={"net_arch": arch}).policy
        assert policy.action_net.in_features == 8
        assert policy.value_net.in_features == 16
        assert policy.cost_net.in_features == 4


class TestCollecting:
    def test_a_callback_may_edit_the_rewards_in_place(self):
        class Seven(BaseCallback):
            def _on_step(self):
                self.locals["rewards"][:] = 7.0
                return True

        model = make(env=line(end="terminated"), gamma=0.5)
        model.learn(32, callback=Seven())
        assert (model.rollout_buffer.rewards == 7.0).all()
        assert model.ep_info_buffer[0]["r"] < 4 * 2 * 2 + 1  # the monitor has the true reward

    def test_locals_show_what_stable_baselines3_shows(self):
        recorded = Recorded()
        make().learn(32, callback=recorded)
        names = {"new_obs", "rewards", "dones", "infos", "actions", "clipped_actions", "env"}
        assert names <= set(recorded.step)

    def test_the_reward_scale_is_learned_from_but_not_reported(self):
        model = make(env=line(end="terminated"), reward_scale=10.0)
        model.learn(32)
        totals = model.rollout_buffer.rewards.reshape(2, 4, 2, 2).sum(axis=(1, 3))
        reported = sorted(info["r"] for info in model.ep_info_buffer)
        assert sorted((totals / 10.0).ravel().tolist()) == pytest.approx(reported)

    @pytest.mark.parametrize(("end", "bootstrapped"), [("truncated", True), ("terminated", False)])
    def test_a_time_limit_is_bootstrapped_and_a_true_end_is_not(self, end, bootstrapped):
        model = make(env=line(end=end), gamma=0.5, cost_limits=100.0, cost_gamma=0.25)
        with th.no_grad():  # V = 10 and V_c = 20 everywhere
            for net, value in ((model.policy.value_net, 10.0), (model.policy.cost_net, 20.0)):
                net.weight.zero_()
                net.bias.fill_(value)
        collect(model)
        buffer, last = model.rollout_buffer, [3, 7]
        earned = 1.0 + buffer.actions[last, :, 0]
        costs = buffer.actions[last, :, 0].reshape(2, 2, 2).sum(axis=2)
        np.testing.assert_allclose(buffer.rewards[last], earned + 5.0 * bootstrapped)
        np.testing.assert_allclose(buffer.costs[last, :, 0, 0], costs + 5.0 * bootstrapped)

    def test_the_bootstrap_uses_the_last_observations_of_the_whole_team(self):
        model = make(env=line(n_worlds=1), gamma=1.0)
        with th.no_grad():  # V of an agent = its own final position, read off the joint observation
            value = model.policy
            value.mlp_extractor.value_net = th.nn.Identity()
            value.value_net = th.nn.Linear(6, 2)
            value.value_net.weight.zero_()
            value.value_net.bias.zero_()
            value.value_net.weight[0, 0] = value.value_net.weight[1, 3] = 1.0
        collect(model)
        steps = model.rollout_buffer.actions[:4, :, 0]
        positions = np.array([0.0, 1.0]) + (1 + steps).sum(axis=0)
        np.testing.assert_allclose(model.rollout_buffer.rewards[3], 1 + steps[3] + positions)

    def test_log_probabilities_are_those_of_the_policy_that_acted(self):
        model = make()
        collect(model)
        inputs = model.rollout_buffer._network_inputs()
        new = model.policy.evaluate_steps(*inputs).log_prob
        old = th.as_tensor(model.rollout_buffer.log_probs).reshape(new.shape)
        assert th.exp(new - old).eq(1.0).all()

    def test_both_backends_learn_the_same_parameters(self):
        models = [
            make(env=line(2, backend, spread=5)).learn(128) for backend in ("auto", "supersuit")
        ]
        assert parameters(models[0]).equal(parameters(models[1]))


class TestConstraints:
    def test_the_dual_step_uses_episodes_that_finished_in_the_rollout(self):
        # all fast costs 8 an episode, limit 3, so J - l = 5
        model = all_fast(make(cost_limits=3.0)).learn(32)
        assert model.multipliers.values.item() == pytest.approx(0.05 * 5)

    def test_a_margin_lowers_what_the_multipliers_aim_at(self):
        # (1 - 0.25) 4 = 3, as above; without a margin the violation would be 4
        model = all_fast(make(cost_limits=4.0, cost_margin=0.25)).learn(32)
        assert model.multipliers.values.item() == pytest.approx(0.05 * 5)
        assert model.cost_limits.tolist() == [4.0]

    def test_individual_limits_are_the_teams_divided_by_n(self):
        # agent_0 costs 2 a step: J = (8, 4), limit 6 / 2 = 3; steps are multiplied by N = 2
        env = line(agent_costs=(2.0, 1.0))
        model = all_fast(make(env=env, cost_limits=6.0, cost_scope="individual")).learn(32)
        expected = pytest.approx([2 * 0.05 * 5, 2 * 0.05 * 1])
        assert model.multipliers.values[:, 0].tolist() == expected

    def test_a_team_cost_can_be_the_maximum_over_agents(self):
        env = line(agent_costs=(2.0, 1.0), team_cost="max")
        model = all_fast(make(env=env, cost_limits=3.0)).learn(32)
        assert model.multipliers.values.item() == pytest.approx(0.05 * (4 * 2 - 3))

    def test_without_a_finished_episode_lambda_stays(self):
        model = make(env=line(length=50), cost_limits=0.0, multipliers_kwargs={"initial": 0.7})
        model.learn(32)
        assert model.multipliers.values.item() == pytest.approx(0.7)

    def test_an_episode_over_several_rollouts_counts_in_full(self):
        model = make(env=line(length=16), cost_limits=0.0, multipliers_kwargs={"learning_rate": 1})
        all_fast(model).learn(64)
        assert model.multipliers.values.item() == pytest.approx(32.0)

    def test_limits_need_an_environment_with_costs(self):
        with pytest.raises(ValueError, match="agent 'agent_0' of world 0 reports 0 costs in info"):
            make(env=line(n_costs=0), cost_limits=1.0).learn(32)

    def test_the_number_of_limits_must_be_the_number_of_costs(self):
        with pytest.raises(
            ValueError, match=r"there are 1 cost limits, but agent .* reports 2 costs"
        ):
            make(env=line(n_costs=2), cost_limits=1.0).learn(32)

    def test_costs_without_limits_are_only_watched(self):
        recorded = Recorded()
        make().learn(64, callback=recorded)
        assert recorded.values["rollout/ep_cost_mean"] >= 0.0
        assert not any("lambda" in key for key in recorded.values)

    def test_the_log_has_the_costs_and_multipliers_of_every_constraint(self):
        recorded = Recorded()
        make(env=line(n_costs=2), cost_limits=[1.0, 2.0]).learn(64, callback=recorded)
        for key in ("train/lambda_0", "train/lambda_1", "train/cost_value_loss"):
            assert key in recorded.values
        means = [recorded.values[f"rollout/ep_cost_{j}_mean"] for j in (0, 1)]
        assert means[1] == pytest.approx(2 * means[0])
        assert recorded.values["time/env_steps"] == 32


class TestLearning:
    """Going fast in step t earns g = 4, 3, 2, 1 more and costs 1; the limit is 4 for both agents.

    With entropy coefficient 1 and multiplier λ the optimal probability of going fast is
    σ(g − λ). Without limit λ = 0: 0.98, 0.95, 0.88, 0.73, which costs 2 · 3.55 = 7.1 and earns
    8 + 2 · (4 · 0.98 + 3 · 0.95 + 2 · 0.88 + 0.73) = 26.5. The limit is met at λ = 2.5, where the
    probabilities 0.82, 0.62, 0.38, 0.18 cost 2 · 2 = 4 and earn 20.2.
    """

    def trained(self, **kwargs):
        env = line(n_worlds=32, gains=DIMINISHING)
        model = MAPPO(
            "MlpPolicy", env, n_steps=4, batch_size=256, n_epochs=4, gamma=1.0, seed=0,
            learning_rate=lambda progress: 5e-3 * progress, ent_coef=1.0, device="cpu",
            normalize_advantage=False, normalize_values=True, **kwargs,
        )  # fmt: skip
        model.learn(30_000)
        return model, evaluate_team(model, env, n_episodes=512, deterministic=False)

    def test_without_limit_the_team_earns_most_and_breaks_the_limit(self):
        _, result = self.trained()
        assert result.mean_return == pytest.approx(26.5, abs=1.0)
        assert result.mean_costs[0] == pytest.approx(7.1, abs=0.6)

    @pytest.mark.parametrize("scope", ["team", "individual"])
    def test_under_a_limit_it_finds_the_multiplier_that_meets_it(self, scope):
        model, result = self.trained(cost_limits=4.0, cost_scope=scope)
        assert result.mean_costs[0] == pytest.approx(4.0, abs=0.7)
        assert result.mean_return == pytest.approx(20.2, abs=1.6)
        assert 1.5 < model.multipliers.values.mean() < 4.5

    def test_pid_multipliers_find_it_too(self):
        gains = {"kp": 0.1, "ki": 0.05, "kd": 0.1}
        _, result = self.trained(
            cost_limits=4.0, multipliers_class=PIDMultipliers, multipliers_kwargs=gains
        )
        assert result.mean_costs[0] == pytest.approx(4.0, abs=0.7)


class TestSaving:
    def test_a_loaded_model_acts_alike_and_goes_on_with_its_multipliers(self, tmp_path):
        env = line()
        model = make(
            env=env, cost_limits=3.0, normalize_values=True, multipliers_class=PIDMultipliers,
            critic_learning_rate=1e-3,
        ).learn(64)  # fmt: skip
        model.save(tmp_path / "model")
        loaded = MAPPO.load(tmp_path / "model", env=line(n_worlds=4), device="cpu")
        assert parameters(loaded).equal(parameters(model))
        assert loaded.multipliers.values.equal(model.multipliers.values)
        assert loaded.multipliers.integral.equal(model.multipliers.integral)
        assert loaded.policy.value_norm.mean.equal(model.policy.value_norm.mean)
        assert loaded.policy.optimizer.state_dict()["state"][0]["step"] == model._n_updates * 2
        assert loaded.policy.optimizer.param_groups[1]["lr"] == 1e-3
        loaded.learn(128, reset_num_timesteps=False)
        assert loaded.num_timesteps == 64 + 128

    def test_without_environment_a_loaded_model_predicts_from_a_local_observation(self, tmp_path):
        model = make(cost_limits=3.0).learn(32)
        model.save(tmp_path / "model.zip")
        loaded = MAPPO.load(tmp_path / "model.zip", device="cpu")
        obs = np.array([0.0, 1.0, 0.0], np.float32)
        assert loaded.predict(obs, deterministic=True) == model.predict(obs, deterministic=True)

    def test_agents_that_run_one_at_a_time_get_the_return_of_the_flattened_team(self):
        model = make().learn(64)
        flattened = evaluate_team(model, line(n_worlds=1), n_episodes=1, deterministic=True)
        env = TwoOnALine()
        obs, _ = env.reset()
        total = 0.0
        while env.agents:
            actions = {a: int(model.predict(obs[a], deterministic=True)[0]) for a in env.agents}
            obs, rewards, _, _, _ = env.step(actions)
            total += sum(rewards.values())
        assert total == flattened.returns[0]

    @pytest.mark.parametrize("changed", [{"cost_limits": 2.0}, {"cost_scope": "individual"}])
    def test_other_limits_at_loading_are_explained(self, tmp_path, changed):
        make(cost_limits=None if "cost_limits" in changed else 1.0).save(tmp_path / "model")
        with pytest.raises(ValueError, match=f"{next(iter(changed))}: .* for other limits"):
            MAPPO.load(tmp_path / "model", env=line(), **changed)

    def test_the_advice_of_that_works(self):
        old, new = make().learn(32), make(cost_limits=1.0)
        parts = ("mlp_extractor.policy_net", "action_net", "log_std", "actor_gru")
        actor = {k: v for k, v in old.policy.state_dict().items() if k.startswith(parts)}
        new.policy.load_state_dict(actor, strict=False)
        obs = np.random.default_rng(0).random((8, 3), np.float32)
        actions = [model.predict(obs, deterministic=True)[0] for model in (old, new)]
        assert np.array_equal(*actions)

    def test_a_model_without_an_environment_says_so(self, tmp_path):
        make().save(tmp_path / "model")
        with pytest.raises(ValueError, match="the model has no environment"):
            MAPPO.load(tmp_path / "model").learn(32)

    def test_a_model_of_another_team_is_refused(self, tmp_path):
        make().save(tmp_path / "model")
        solo = line(n_worlds=1)
        solo.agents = ["agent_0"]
        with pytest.raises(ValueError, match=r"has the agents \['agent_0'\], but the model"):
            MAPPO.load(tmp_path / "model", env=solo)
        model = make()
        before = model.env
        other = line()
        other.agents = ["x", "y"]
        with pytest.raises(ValueError, match=r"has the agents \['x', 'y'\], but the model"):
            model.set_env(other)
        with pytest.raises(ValueError, match=r"reports 1 numbers in info\['critic_state'\], but"):
            model.set_env(line(critic_state=True))
        assert model.env is before

    def test_a_crash_while_saving_leaves_the_old_file(self, tmp_path, monkeypatch):
        model = make()
        model.save(tmp_path / "model")
        before = (tmp_path / "model.zip").read_bytes()

        def crash(*args, **kwargs):
            raise OSError("disk full")

        monkeypatch.setattr(th, "save", crash)
        with pytest.raises(OSError, match="disk full"):
            model.save(tmp_path / "model")
        assert (tmp_path / "model.zip").read_bytes() == before
        assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]

    def test_checkpoints_are_whole_archives(self, tmp_path):
        make().learn(64, callback=CheckpointCallback(save_freq=8, save_path=str(tmp_path)))
        names = sorted(path.name for path in tmp_path.iterdir())
        assert names == ["rl_model_32_steps.zip", "rl_model_64_steps.zip"]
        assert all(zipfile.is_zipfile(tmp_path / name) for name in names)

    def test_continued_training_keeps_running_episodes(self):
        model = make(env=line(length=16), cost_limits=0.0, multipliers_kwargs={"learning_rate": 1})
        all_fast(model).learn(32)
        model.learn(32, reset_num_timesteps=False)
        assert model.multipliers.values.item() == pytest.approx(32.0)


class TestGoingOn:
    def test_a_callback_that_stops_leaves_the_episode_costs_right(self):
        # all fast: every episode costs 8
        model = make(cost_limits=0.0, multipliers_kwargs={"learning_rate": 1.0})
        all_fast(model).learn(10_000, callback=StopTrainingOnMaxEpisodes(max_episodes=1))
        model.learn(32, reset_num_timesteps=False)
        assert np.ravel(model._collector.finished_costs).tolist() == [8.0] * 4

    @pytest.mark.parametrize("limits", [5.0, [5.0]])
    def test_a_limit_can_be_changed_while_loading(self, tmp_path, limits):
        make(cost_limits=1.0).save(tmp_path / "model")
        loaded = MAPPO.load(tmp_path / "model", env=line(), device="cpu", cost_limits=limits)
        assert all_fast(loaded).learn(32).multipliers.values.item() == pytest.approx(0.05 * 3)

    def test_an_environment_need_not_be_reset(self, tmp_path):
        env = line()
        make(env=env).learn(32).save(tmp_path / "model")
        loaded = MAPPO.load(tmp_path / "model", env=env, force_reset=False, device="cpu")
        loaded.learn(32, reset_num_timesteps=False)
        assert loaded.num_timesteps == 64

    def test_clipped_values_and_normalized_values_go_together(self):
        # returns around 400 move the normalizer a lot after the first rollout
        class Rich(TwoOnALine):
            batched = None

            def step(self, actions):
                obs, rewards, *rest = super().step(actions)
                return obs, {agent: reward + 100.0 for agent, reward in rewards.items()}, *rest

        errors = []
        for clip in (None, 0.2):
            env = share_parameters(Rich, 2)
            model = make(
                env=env, normalize_values=True, clip_range_vf=clip, learning_rate=3e-3, n_epochs=10
            )
            model.learn(32 * 20)
            buffer = model.rollout_buffer
            errors.append(np.square(buffer.values - buffer.returns).mean())
        assert max(errors) < 30_000  # 50,000 and more if the clip has the units of the returns


class TestEntropy:
    def test_e2c_gives_the_bonus_of_the_fifth_neighbor_by_default(self):
        model = make(E2CMAPPO, env=line(end="terminated")).learn(32)
        callback = model._oem_callback
        assert callback.estimator.k == 5
        first_steps = model.rollout_buffer.rewards[[0, 4]]
        assert (first_steps == 0.0).all()  # nothing has been observed before
        assert (model.rollout_buffer.rewards[[1, 5]] > 0.0).all()

    def test_it_gives_another_bonus_on_request_and_logs_it(self):
        recorded = Recorded()
        kwargs = {"estimator": "visit_count", "psi": 0.5}
        model = make(E2CMAPPO, env=line(end="terminated"), oem_kwargs=kwargs)
        model.learn(64, callback=recorded)
        # every observation says 1 for "something": n-th step earns its reward + 0.5 / n
        bonus = model.rollout_buffer.rewards - 1 - model.rollout_buffer.actions[..., 0]
        np.testing.assert_allclose(bonus[:4, 0], [0.5, 0.25, 0.5 / 3, 0.125], rtol=1e-6)
        assert recorded.values["rollout/ep_oem_mean"] == pytest.approx(1 + 1 / 2 + 1 / 3 + 1 / 4)

    @pytest.mark.parametrize("wrap", [lambda own: own, lambda own: [CallbackList([own])]])
    def test_a_callback_of_the_users_own_replaces_it(self, wrap):
        own = OEMRewardCallback(VisitCount(), psi=None)
        model = make(E2CMAPPO, env=line(end="terminated"))
        model.learn(32, callback=wrap(own))
        assert (model.rollout_buffer.rewards[[0, 4]] == 1.0).all()

    def test_other_callbacks_are_initialized_once(self):
        calls = []

        class Counted(BaseCallback):
            def _init_callback(self):
                calls.append("init")

            def _on_step(self):
                return True

        make(E2CMAPPO).learn(32, callback=[Counted(), lambda *_: True])
        assert calls == ["init"]

    def test_mappo_with_the_callback_is_e2c(self):
        kwargs = {"estimator": "nearest_neighbor", "estimator_kwargs": {"k": 5}}
        with_callback = make().learn(64, callback=OEMRewardCallback(**kwargs))
        assert parameters(with_callback).equal(parameters(make(E2CMAPPO).learn(64)))

    def test_its_settings_are_saved(self, tmp_path):
        kwargs = {"estimator": "visit_count", "psi": 0.5}
        make(E2CMAPPO, oem_kwargs=kwargs).save(tmp_path / "model")
        loaded = E2CMAPPO.load(tmp_path / "model", env=line(), device="cpu").learn(32)
        assert loaded._oem_callback.psi == 0.5
        assert isinstance(loaded._oem_callback.estimator, VisitCount)


class TestRunning:
    def test_the_same_seed_gives_the_same_parameters_bit_for_bit(self):
        first, second = (make(env=line(spread=5), cost_limits=2.0).learn(128) for _ in range(2))
        other = make(env=line(spread=5), cost_limits=2.0, seed=1).learn(128)
        assert parameters(first).equal(parameters(second))
        assert not parameters(first).equal(parameters(other))

    def test_callbacks_of_stable_baselines3_stop_the_training(self):
        model = make().learn(10_000, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
        assert model.num_timesteps == 2 * 4 * 4

    def test_observations_can_be_normalized_and_so_are_the_last_ones_of_an_episode(self):
        env = VecNormalize(line(spread=5), gamma=0.99)
        model = make(env=env, cost_limits=2.0)
        model.learn(32)
        timeouts = model.rollout_buffer.timeouts
        assert [timeout.step for timeout in timeouts] == [3, 7]
        positions = env.unnormalize_obs(timeouts[0].observations)[:, 2]
        # normalized with the statistics of that moment: t = 4 looks far above the mean, not 4
        assert (timeouts[0].observations[:, 2] > 1.0).all()
        assert positions == pytest.approx(4.0, abs=1.0)
        assert model.ep_info_buffer[0]["r"] >= 8  # reported as the environment gives it

    def test_a_pettingzoo_environment_is_one_world(self):
        model = make(env=TwoOnALine()).learn(16)
        assert model.n_envs == model.n_agents == 2

    def test_target_kl_stops_the_epochs(self, capsys):
        model = make(target_kl=1e-9, n_epochs=10, learning_rate=0.01, verbose=1).learn(32)
        assert model._n_updates < 10
        assert "Early stopping at epoch" in capsys.readouterr().out

    def test_learning_rates_of_actor_and_critics_follow_their_own_schedules(self):
        model = make(learning_rate=lambda p: p, critic_learning_rate=lambda p: 2 * p)
        model._setup_learn(32)
        model._current_progress_remaining = 0.25
        model._update_learning_rate(model.policy.optimizer)
        assert [g["lr"] for g in model.policy.optimizer.param_groups] == [0.25, 0.5]

    def test_ppo_learns_on_the_same_slots(self):
        env = line(n_worlds=16)
        model = PPO(
            "MlpPolicy", env, n_steps=4, batch_size=64, gamma=0.9, seed=0, device="cpu",
            learning_rate=3e-3,
        ).learn(4000)  # fmt: skip
        assert evaluate_team(model, env, 16).mean_return == 16.0  # all fast


class TestErrors:
    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"cost_limits": -1.0}, "cost_limits is -1.0; expected None, a number"),
            ({"cost_scope": "joint"}, "cost_scope is 'joint'; expected one of"),
            ({"batch_size": 1}, "batch_size is 1, smaller than the team of 2 agents"),
            ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": [8]}}}, "expected 'pi', 'vf'"),
            ({"cost_limits": 1, "multipliers_kwargs": {"initial": -1}}, "initial is -1; expected"),
            ({"cost_limits": "much"}, "cost_limits is 'much'; expected None, a number"),
            ({"n_epochs": 0}, "n_epochs is 0; expected a whole number of at least 1"),
            ({"batch_size": "x"}, "batch_size is 'x'; expected a whole number"),
            ({"policy_kwargs": {"net_arch": [-3]}}, "expected a list of layer sizes"),
            ({"multipliers_class": "PID"}, "multipliers_class is 'PID'; expected a subclass"),
        ],
    )
    def test_arguments_that_make_no_sense_are_refused(self, kwargs, message):
        with pytest.raises((ValueError, TypeError), match=message):
            make(**kwargs)

    def test_a_policy_of_another_kind_is_refused(self):
        with pytest.raises(TypeError, match=r"policy_class is .*expected a subclass of TeamPolicy"):
            MAPPO(ActorCriticPolicy, line(), device="cpu")

    def test_the_last_observation_must_be_finite_too(self):
        class Broken(TwoOnALine):
            batched = None

            def step(self, actions):
                obs, *rest = super().step(actions)
                if self.t == self.length:
                    obs["agent_1"][0] = np.nan
                return obs, *rest

        model = make(env=share_parameters(Broken, 2))
        with pytest.raises(ValueError, match="terminal_observation of world 0, agent 'agent_1' is"):
            model.learn(32)

    def test_a_missing_critic_state_is_located(self):
        class Forgetful(TwoOnALine):
            batched = None

            def step(self, actions):
                *rest, infos = super().step(actions)
                return *rest, {agent: {"cost": 0.0} for agent in infos}

        model = make(env=share_parameters(lambda: Forgetful(critic_state=True), 2))
        with pytest.raises(
            ValueError, match=r"'critic_state'\] of world 0 has the shape \(0,\); ex"
        ):
            model.learn(32)

    def test_parameters_that_explode_are_explained(self):
        model = make(learning_rate=1e30)
        with pytest.raises(ValueError, match=r"(have diverged|loss is \w+) after .* Lower learn"):
            model.learn(320)

    @pytest.mark.parametrize("quantity", ["observation", "reward", "cost"])
    @pytest.mark.parametrize("number", [np.nan, np.inf])
    def test_a_number_that_is_not_finite_stops_the_run_and_is_located(self, quantity, number):
        class Broken(TwoOnALine):
            batched = None

            def step(self, actions):
                obs, rewards, terminated, truncated, infos = super().step(actions)
                if self.t == 3:
                    obs["agent_1"][1] = number if quantity == "observation" else 0.0
                    rewards["agent_1"] = number if quantity == "reward" else 0.0
                    infos["agent_1"]["cost"] = number if quantity == "cost" else 0.0
                return obs, rewards, terminated, truncated, infos

        model = make(env=share_parameters(Broken, 2), cost_limits=1.0, cost_scope="individual")
        before = parameters(model)
        message = rf"{quantity} of world 0, agent 'agent_1' is not finite at step 2 of the rollout"
        with pytest.raises(ValueError, match=message):
            model.learn(32)
        assert parameters(model).equal(before)

    def test_a_loss_that_is_not_finite_stops_the_run_before_the_step(self):
        model = make(reward_scale=1e30)
        before = parameters(model)
        with pytest.raises(ValueError, match=r"the loss is \w+ after 32 agent steps"):
            model.learn(32)
        assert parameters(model).equal(before)

    def test_supersuits_own_vector_environment_is_refused(self):
        import supersuit as ss

        class Unbatched(TwoOnALine):
            batched = None

        rows = ss.pettingzoo_env_to_vec_env_v1(Unbatched())
        env = ss.concat_vec_envs_v1(rows, 2, base_class="stable_baselines3")
        with pytest.raises(TypeError, match=r"use sb3_e2c.share_parameters"):
            make(env=env)


@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
def test_actor_and_critics_may_have_features_extractors_of_their_own(policy):
    env = share_parameters(TwoOnALine, n_worlds=2)
    kwargs = {"share_features_extractor": False}
    model = MAPPO(policy, env, n_steps=8, batch_size=16, n_epochs=1, policy_kwargs=kwargs)
    model.learn(32)
    assert model.num_timesteps == 32


def test_a_team_that_learns_from_a_bonus_is_not_loaded_without_it(tmp_path):
    env = share_parameters(TwoOnALine, n_worlds=2)
    E2CMAPPO("MlpPolicy", env, n_steps=8, batch_size=16).save(tmp_path / "team")
    with pytest.raises(ValueError, match=r"load it with E2CMAPPO\.load"):
        MAPPO.load(tmp_path / "team")
