"""Evaluation by world episodes, and the callback that keeps the best safe model."""

import os

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import FAST, SLOW, TwoOnALine
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_e2c import MAPPO
from sb3_e2c.evaluation import TeamEvalCallback, TeamEvaluation, evaluate_team
from sb3_e2c.monitor import TeamMonitor
from sb3_e2c.vec_env import share_parameters


class Fixed:
    """Every agent always acts as told; notes what it is asked with."""

    def __init__(self, actions=(SLOW, FAST)):
        self.actions, self.starts, self.states = actions, [], []

    def predict(self, observations, state=None, episode_start=None, deterministic=False):
        self.starts.append(episode_start.tolist())
        self.states.append(state)
        n_steps = 0 if state is None else state[0]
        return np.tile(self.actions, len(observations) // 2), (n_steps + 1,)


def worlds(n_worlds=2, **parameters):
    return share_parameters(lambda: TwoOnALine(**parameters), n_worlds)


def test_returns_and_costs_of_teams_and_agents():
    # Four steps: agent_0 slow earns 4, agent_1 fast earns 8 at cost 4; the second cost is twice.
    result = evaluate_team(Fixed(), worlds(n_costs=2), n_episodes=3)
    assert result.returns.tolist() == [12] * 3
    assert result.agent_returns.tolist() == [[4, 8]] * 3
    assert result.costs.tolist() == [[4, 8]] * 3
    assert result.agent_costs.tolist() == [[[0, 0], [4, 8]]] * 3
    assert result.lengths.tolist() == [4] * 3
    assert (result.mean_return, result.mean_costs.tolist()) == (12, [4, 8])


def test_a_shared_reward_counts_once_and_a_maximum_of_costs_is_taken_at_each_step():
    env = worlds(shared=True, team_cost="max", agent_costs=(1.0, 3.0))
    result = evaluate_team(Fixed((FAST, FAST)), env, n_episodes=2)
    assert result.returns.tolist() == [16] * 2  # both get 2 + 2 at four steps
    assert result.agent_returns.tolist() == [[16, 16]] * 2
    assert result.costs.tolist() == [[12]] * 2  # four times max(1, 3)
    assert result.agent_costs.tolist() == [[[4], [12]]] * 2


def test_an_environment_without_costs_has_none():
    result = evaluate_team(Fixed(), worlds(n_costs=0), n_episodes=2)
    assert (result.costs.shape, result.agent_costs.shape) == ((2, 0), (2, 2, 0))
    assert result.violation_rate([]) == 0
    with pytest.raises(ValueError, match="there are 1 cost limits, but the environment reports 0"):
        result.violation_rate(3.0)


def test_episodes_are_divided_among_worlds_beforehand():
    # World 0 ends after 1 step, world 1 after 4: two episodes of each, not four short ones.
    env = worlds()
    env.set_options([{"length": 1}] * 2 + [{"length": 4}] * 2)
    result = evaluate_team(Fixed(), env, n_episodes=4)
    assert result.lengths.tolist() == [1, 1, 4, 4]
    assert result.returns.tolist() == [3, 3, 12, 12]


@pytest.mark.parametrize("n_episodes", [1, 2, 5])
def test_exactly_as_many_episodes_as_wanted(n_episodes):
    assert len(evaluate_team(Fixed(), worlds(3), n_episodes).returns) == n_episodes


def test_a_recurrent_state_is_kept_until_the_slot_itself_ends():
    model = Fixed()
    env = worlds()
    env.set_options([{"length": 2}] * 2 + [{"length": 4}] * 2)
    evaluate_team(model, env, n_episodes=2)
    starts, ends, goes_on = [True] * 4, [True, True, False, False], [False] * 4
    assert model.starts == [starts, goes_on, ends, goes_on]
    assert model.states == [None, (1,), (2,), (3,)]


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: env,
        TeamMonitor,
        VecNormalize,
        lambda env: VecNormalize(TeamMonitor(env)),
        lambda env: TeamMonitor(VecNormalize(env)),
    ],
)
def test_wrappers_do_not_change_the_result(wrap):
    result = evaluate_team(Fixed(), wrap(worlds()), n_episodes=3)
    assert result.agent_returns.tolist() == [[4, 8]] * 3
    assert result.costs.tolist() == [[4]] * 3


def test_violations_are_counted_by_episode_and_by_mean():
    result = TeamEvaluation(
        returns=np.zeros(4),
        agent_returns=np.zeros((4, 1)),
        costs=np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 9.0], [2.0, 7.0]]),
        agent_costs=np.zeros((4, 1, 2)),
        lengths=np.ones(4),
    )
    # Means 2 and 4. Over (2, 8): the third episode; exactly at a limit is within it.
    assert result.violation_rate([2, 8]) == 0.25
    assert result.violation([2, 8]) == 0
    assert result.violation([1.5, 3]) == 0.5 + 1
    with pytest.raises(ValueError, match="1 cost limits, but the environment reports 2"):
        result.violation_rate(2.0)


def test_a_callback_sees_every_counted_step_of_a_world():
    seen = []

    def callback(locals_, globals_):
        seen.append((locals_["world"], locals_["info"]["cost"], locals_["done"]))

    evaluate_team(Fixed((FAST, SLOW)), worlds(2, length=2), n_episodes=1, callback=callback)
    # One episode for two worlds is world 1's.
    assert seen == [(1, 1.0, False), (1, 1.0, True)]


def test_it_can_render(monkeypatch):
    env = worlds(2, length=3, render_mode="rgb_array")
    frames = []
    monkeypatch.setattr(env, "render", lambda: frames.append(env.get_images()))
    evaluate_team(Fixed(), env, n_episodes=2, render=True)
    assert [len(frame) for frame in frames] == [2, 2, 2]


def test_bad_requests_are_explained():
    with pytest.raises(ValueError, match="n_episodes is 0; expected at least 1"):
        evaluate_team(Fixed(), worlds(), n_episodes=0)
    for bad in (TwoOnALine(), DummyVecEnv([lambda: gym.make("CartPole-v1")])):
        with pytest.raises(TypeError, match="expected one made by share_parameters"):
            evaluate_team(Fixed(), bad)
    with pytest.raises(TypeError, match="TeamEvalCallback was given an environment of type"):
        TeamEvalCallback(TwoOnALine())


class Scripted(TeamEvalCallback):
    """Finds, instead of evaluating, what it is told: pairs of a return and a cost."""

    def script(self, *outcomes):
        self.outcomes = list(outcomes)
        return self

    def _evaluate(self):
        returned, cost = self.outcomes.pop(0)
        one = np.ones((1, 1))
        return TeamEvaluation(one[0] * returned, one, one * cost, one[..., None], one[0])


class Noting(BaseCallback):
    """Notes how often it is called, and with which best mean reward of its parent."""

    def __init__(self):
        super().__init__()
        self.best = []

    def _on_step(self):
        self.best.append(self.parent.best_mean_reward)
        return True


def ppo(env, seed=0, **kwargs):
    return PPO(
        "MlpPolicy", env, n_steps=4, batch_size=8, n_epochs=1, seed=seed, device="cpu", **kwargs
    )


def bests(cost_limits, outcomes):
    """Mean returns at each new best model."""
    new_best = Noting()
    callback = Scripted(
        worlds(), cost_limits, callback_on_new_best=new_best, eval_freq=1, verbose=0
    )
    model = ppo(worlds())
    model.set_logger(configure(None, []))
    callback.script(*outcomes).init_callback(model)
    for _ in range(len(outcomes)):
        callback.on_step()
    return new_best.best


@pytest.mark.filterwarnings("ignore:Training and eval env")
class TestTheBestModel:
    def test_without_limits_it_has_the_highest_return(self):
        assert bests(None, [(1, 9), (3, 99), (2, 0), (3, 0), (4, 9)]) == [1, 3, 4]

    def test_it_is_safe_before_it_is_good(self):
        # Violations of the limit 5: 4, 2, 3, then safe with 1; 8 is unsafe; 2 is better than 1.
        outcomes = [(9, 9), (7, 7), (8, 8), (1, 5), (8, 6), (2, 3), (1.5, 0)]
        assert bests(5, outcomes) == [9, 7, 1, 2]

    def test_equal_violations_are_decided_by_the_return(self):
        assert bests(5, [(1, 7), (2, 7), (1, 7)]) == [1, 2]


class TestCallback:
    def train(self, tmp_path, n_calls=8, env=None, eval_env=None, model=None, **kwargs):
        env = TeamMonitor(worlds(n_costs=2)) if env is None else env
        eval_env = worlds(n_costs=2) if eval_env is None else eval_env
        callback = TeamEvalCallback(
            eval_env,
            n_eval_episodes=3,
            eval_freq=4,
            log_path=str(tmp_path),
            best_model_save_path=str(tmp_path / "best"),
            **{"verbose": 0, **kwargs},
        )
        model = ppo(env) if model is None else model
        self.logged = []
        logger = configure(None, [])
        logger.dump = lambda step=0: (
            self.logged.append((step, dict(logger.name_to_value))),
            logger.name_to_value.clear(),
        )
        model.set_logger(logger)
        model.learn(4 * n_calls, callback=callback)
        return callback

    def evaluations(self):
        return [(step, log) for step, log in self.logged if "eval/mean_reward" in log]

    def test_the_file_has_the_keys_of_sb3_and_the_costs(self, tmp_path):
        callback = self.train(tmp_path)
        with np.load(tmp_path / "evaluations.npz") as file:
            arrays = dict(file)
        assert arrays["timesteps"].tolist() == [16, 32]  # two calls of four, four slots
        assert arrays["results"].shape == arrays["ep_lengths"].shape == (2, 3)
        assert arrays["costs"].shape == (2, 3, 2)
        assert (arrays["ep_lengths"] == 4).all()
        assert sorted(os.listdir(tmp_path)) == ["best", "evaluations.npz"]
        assert os.listdir(tmp_path / "best") == ["best_model.zip"]
        # Each fast step earns 1 more than the 8 of all slow, and costs 1 and 2.
        assert np.allclose(arrays["results"], 8 + arrays["costs"][..., 0])
        assert np.allclose(arrays["costs"][..., 1], 2 * arrays["costs"][..., 0])
        assert callback.last_mean_reward == arrays["results"][-1].mean()

    def test_a_file_that_cannot_be_written_to_its_end_leaves_the_one_before(
        self, tmp_path, monkeypatch
    ):
        callback = self.train(tmp_path)
        before = (tmp_path / "evaluations.npz").read_bytes()

        def half(file, **_):
            file.write(before[:100])
            raise OSError("no space left")

        monkeypatch.setattr(np, "savez", half)
        with pytest.raises(OSError, match="no space"):
            callback.write_evaluations()
        assert sorted(os.listdir(tmp_path)) == ["best", "evaluations.npz"]
        assert (tmp_path / "evaluations.npz").read_bytes() == before

    def test_what_is_logged(self, tmp_path):
        self.train(tmp_path, cost_limits=[-0.0, 1e9])
        (step, log), _ = self.evaluations()
        assert step == log["time/total_timesteps"] == 16
        evaluated = {name: value for name, value in log.items() if name.startswith("eval/")}
        names = "mean_reward mean_ep_length mean_cost_0 mean_cost_1 violation_rate"
        assert set(evaluated) == {f"eval/{name}" for name in names.split()}
        assert evaluated["eval/mean_reward"] == 8 + evaluated["eval/mean_cost_0"]
        assert evaluated["eval/mean_ep_length"] == 4

    def test_one_cost_is_called_mean_cost_and_no_limits_log_no_violations(self, tmp_path):
        self.train(tmp_path, eval_env=worlds())
        names = set(self.evaluations()[0][1])
        assert {"eval/mean_cost", "eval/mean_reward"} <= names
        assert "eval/violation_rate" not in names

    def test_limits_are_those_of_the_model_unless_given(self, tmp_path):
        model = ppo(TeamMonitor(worlds(n_costs=2)))
        model.cost_limits = np.array([3.0, 6.0])
        assert self.train(tmp_path, model=model).cost_limits.tolist() == [3, 6]
        given = self.train(tmp_path, model=model, cost_limits=[1.0, 2.0])
        assert given.cost_limits.tolist() == [1, 2]

    def test_a_wrong_number_of_limits_is_explained(self, tmp_path):
        with pytest.raises(ValueError, match="1 cost limits, but the environment reports 2"):
            self.train(tmp_path, cost_limits=3.0)

    def test_normalization_is_shared_with_the_evaluation(self, tmp_path):
        env = VecNormalize(TeamMonitor(worlds(n_costs=2)))
        eval_env = VecNormalize(TeamMonitor(worlds(n_costs=2)), training=False)
        self.train(tmp_path, env=env, eval_env=eval_env)
        assert np.array_equal(eval_env.obs_rms.mean, env.obs_rms.mean)
        assert eval_env.obs_rms.mean.any()

    @pytest.mark.parametrize("monitored", [False, True])
    @pytest.mark.parametrize("kind", [EvalCallback, TeamEvalCallback])
    def test_mappo_makes_both_environments_alike(self, kind, monitored):
        env, own = VecNormalize(worlds()), worlds()
        eval_env = VecNormalize(TeamMonitor(own) if monitored else own, training=False)
        callback = EveryNTimesteps(8, kind(eval_env, eval_freq=1, n_eval_episodes=2, verbose=0))
        settings = {"n_steps": 4, "batch_size": 8, "n_epochs": 1, "device": "cpu"}
        model = MAPPO("MlpPolicy", env, **settings)
        model.learn(16, callback=[CallbackList([callback])])
        assert np.array_equal(eval_env.obs_rms.mean, env.obs_rms.mean)
        assert isinstance(env.venv, TeamMonitor)
        assert isinstance(eval_env.venv, TeamMonitor)
        assert eval_env.venv.venv is own

    def test_environments_that_are_wrapped_differently_are_refused(self, tmp_path):
        env = VecNormalize(TeamMonitor(worlds(n_costs=2)))
        with pytest.warns(UserWarning, match="not of the same type"), pytest.raises(AssertionError):
            self.train(tmp_path, env=env, eval_env=TeamMonitor(worlds(n_costs=2)))

    def test_sb3s_callbacks_can_follow_it(self, tmp_path):
        after = Noting()
        stop = StopTrainingOnRewardThreshold(reward_threshold=0)
        self.train(tmp_path, callback_after_eval=after, callback_on_new_best=stop)
        assert len(self.evaluations()) == 1  # returns are at least 8: stopped at the first
        assert after.best == []

    def test_it_prints_as_sb3_does(self, tmp_path, capsys):
        self.train(tmp_path, n_calls=4, verbose=1, cost_limits=[8.0, 16.0])
        first, second, third, fourth = capsys.readouterr().out.splitlines()[-4:]
        assert first.startswith("Eval num_timesteps=16, episode_reward=")
        assert second == "Episode length: 4.00 +/- 0.00"
        assert third.startswith("mean_cost_0=")
        assert fourth == "New best model!"

    def test_an_evaluation_frequency_of_zero_never_evaluates(self, tmp_path):
        callback = TeamEvalCallback(worlds(), eval_freq=0, verbose=0)
        with pytest.warns(UserWarning, match="not of the same type"):
            ppo(VecNormalize(worlds())).learn(16, callback=callback)
        assert callback.last_mean_reward == -np.inf

    def test_evaluating_changes_nothing_in_the_training(self):
        learned = []
        for evaluate in (False, True):
            model = ppo(worlds())
            evaluation = TeamEvalCallback(worlds(), eval_freq=4, deterministic=False, verbose=0)
            model.learn(96, callback=evaluation if evaluate else None)
            learned.append(np.concatenate([p.detach().ravel() for p in model.policy.parameters()]))
        assert np.array_equal(*learned)

    def test_evaluating_on_the_cpu_wakes_no_gpu(self, monkeypatch):
        forked = []
        fork = th.random.fork_rng
        monkeypatch.setattr(
            th.random, "fork_rng", lambda *a, **k: (forked.append((a, k)), fork(*a, **k))[1]
        )
        ppo(worlds()).learn(8, callback=TeamEvalCallback(worlds(), eval_freq=4, verbose=0))
        assert forked
        assert all(args == ([],) for args, _ in forked)
