"""The reward of Algorithm 1 reaches what an on-policy algorithm learns from."""

import math
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_e2c import E2CMAPPO, MAPPO
from sb3_e2c.callbacks import OEMRewardCallback
from sb3_e2c.entropy import EntropyEstimator, NearestNeighbor, VisitCount
from sb3_e2c.vec_env import share_parameters

# Bonuses of Squares with one neighbor: o_1, o_2, ... = 1, 4, 9, ... are 3, 5, 7, ... apart
FIRST, SECOND, THIRD, FOURTH, FIFTH = 0.0, *(math.log(1 + d) for d in (3, 5, 7, 9))


class Squares(gym.Env):
    """Observation t² (and -1) at step t whatever the action, reward 10, `length` steps."""

    observation_space = gym.spaces.Box(-1e3, 1e3, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, length: int, truncate: bool = False, **infos: Any) -> None:
        self.length, self.truncate, self.infos = length, truncate, infos

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        self.t += 1
        over = self.t == self.length
        infos = {key: value(self.t) for key, value in self.infos.items()}
        return self.observe(), 10.0, over and not self.truncate, over and self.truncate, infos

    def observe(self) -> np.ndarray:
        return np.array([self.t**2, -1], np.float32)


class Log(KVWriter):
    """Keeps what a model logs, one dictionary per rollout."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values, key_excluded, step=0) -> None:
        self.rows.append(dict(key_values))

    def column(self, key: str) -> list[Any]:
        return [row.get(key) for row in self.rows]


def squares(*lengths: int, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda n=n: Squares(n, **kwargs) for n in lengths])


def frozen_model(env: Any, algorithm: Any = A2C, n_steps: int = 6) -> Any:
    """A model that collects but never changes its weights."""
    kwargs = {"batch_size": n_steps * env.num_envs} if algorithm is PPO else {}
    return algorithm("MlpPolicy", env, n_steps=n_steps, learning_rate=0.0, device="cpu", **kwargs)


def learned_rewards(
    env: Any, callback: OEMRewardCallback, algorithm: Any = A2C, n_steps: int = 6
) -> np.ndarray:
    """What the buffer holds after one rollout, shape (slots, steps)."""
    model = frozen_model(env, algorithm, n_steps)
    model.learn(n_steps * env.num_envs, callback)
    return model.rollout_buffer.rewards.T


def nearest(**kwargs: Any) -> OEMRewardCallback:
    return OEMRewardCallback("nearest_neighbor", {"k": 1}, **kwargs)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_the_bonus_reaches_the_buffer_and_monitors_still_count_the_extrinsic_return(algorithm):
    env = VecMonitor(squares(3, 5))
    model = frozen_model(env, algorithm)
    model.learn(12, nearest())
    short, long = model.rollout_buffer.rewards.T
    assert short == pytest.approx([FIRST, SECOND, THIRD, FIRST, SECOND, THIRD])
    assert long == pytest.approx([FIRST, SECOND, THIRD, FOURTH, FIFTH, FIRST])
    assert [episode["r"] for episode in model.ep_info_buffer] == [30, 50, 30]


def test_the_last_observation_of_an_episode_is_scored_in_its_own_episode():
    # the array of new observations already holds the next episode's 0, at distance 1 from o_1
    rewards = learned_rewards(squares(3), nearest())
    assert rewards[0, 2] == pytest.approx(THIRD)
    assert rewards[0, 2] != pytest.approx(math.log(1 + 1))


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_a_time_out_is_bootstrapped_on_top_of_the_bonus(algorithm):
    model = frozen_model(squares(3, truncate=True), algorithm, n_steps=4)
    model.learn(4, nearest())
    with th.no_grad():
        value = float(model.policy.predict_values(th.tensor([[9.0, -1.0]])))
    assert value != 0
    assert model.rollout_buffer.rewards.ravel() == pytest.approx(
        [FIRST, SECOND, THIRD + model.gamma * value, FIRST], rel=1e-5
    )


def test_psi_mixes_the_bonus_with_the_extrinsic_reward():
    rewards = learned_rewards(squares(3), nearest(psi=0.3), n_steps=3)
    assert rewards[0] == pytest.approx([10.0, 10 + 0.3 * SECOND, 10 + 0.3 * THIRD])


def test_psi_may_fall_with_the_remaining_progress():
    model, log = frozen_model(squares(3), n_steps=3), Log()
    model.set_logger(Logger(None, [log]))
    learned = []

    class Keep(BaseCallback):
        def _on_step(self) -> bool:
            learned.append(float(self.locals["rewards"][0]))
            return True

    model.learn(6, [nearest(psi=lambda remaining: 0.3 * remaining), Keep()], log_interval=1)
    first = [10.0, 10 + 0.3 * SECOND, 10 + 0.3 * THIRD]
    second = [10.0, 10 + 0.15 * SECOND, 10 + 0.15 * THIRD]
    assert learned == pytest.approx([*first, *second])
    assert log.column("rollout/oem_psi") == pytest.approx([0.3, 0.15])


def test_a_schedule_without_a_number_stops_the_run():
    with pytest.raises(ValueError, match="got nan"):
        frozen_model(squares(3), n_steps=3).learn(3, nearest(psi=lambda _: math.nan))


def test_beta_weighs_the_bonus_and_counts_as_1_if_it_is_missing_none_or_0():
    betas = {1: 5.0, 2: 5.0, 3: None, 4: 0}
    env = squares(6, beta=lambda t: betas.get(t, np.float32(0.5)))
    rewards = learned_rewards(env, nearest(psi=2.0), n_steps=5)
    assert rewards[0] - 10 == pytest.approx(
        2 * np.array([FIRST, 5 * SECOND, THIRD, FOURTH, 0.5 * FIFTH]), rel=1e-6
    )


def test_a_novelty_observation_replaces_the_observation_also_in_the_last_step():
    env = squares(3, 4, novelty_observation=lambda t: np.array([-1.0, 10.0 * t]))
    rewards = learned_rewards(env, nearest(), n_steps=4)
    ten = math.log(1 + 10)
    assert rewards == pytest.approx(np.array([[0, ten, ten, 0], [0, ten, ten, ten]]))


def test_bonuses_under_vec_normalize_are_those_of_raw_observations():
    plain = learned_rewards(squares(3, 5), nearest())
    env = VecNormalize(squares(3, 5), norm_reward=False)
    assert learned_rewards(env, nearest()) == pytest.approx(plain, rel=1e-5)


def test_nothing_here_is_recognized_under_vec_normalize_also_in_the_last_step():
    # second number: -1 in every step, so only the first one's bin (of width 2) tells steps apart
    callback = OEMRewardCallback("visit_count", {"quantization": 2, "high": 4.0})
    env = VecNormalize(squares(3), norm_reward=False)
    assert learned_rewards(env, callback)[0].tolist() == [1, 1, 1 / 2, 1, 1, 1 / 2]


def test_images_are_scored_as_one_vector():
    callback = started(nearest(), n_slots=1)
    step(callback, np.zeros((1, 3, 2, 2), np.uint8))
    # twelve numbers that differ by 200
    bonus = step(callback, np.full((1, 3, 2, 2), 200, np.uint8))
    assert bonus == pytest.approx([math.log(1 + 200 * math.sqrt(12))])


def test_continued_learning_keeps_the_memory_of_running_episodes():
    model, callback = frozen_model(squares(5), n_steps=3), nearest()
    model.learn(3, callback)
    model.learn(3, callback, reset_num_timesteps=False)
    assert model.rollout_buffer.rewards.ravel() == pytest.approx([FOURTH, FIFTH, FIRST])


def test_learning_anew_starts_with_an_empty_memory():
    model, callback = frozen_model(squares(5), n_steps=3), nearest()
    model.learn(3, callback)
    model.learn(3, callback)
    assert model.rollout_buffer.rewards.ravel() == pytest.approx([FIRST, SECOND, THIRD])


def test_a_loaded_model_starts_with_an_empty_memory(tmp_path):
    model, callback = frozen_model(squares(5), n_steps=3), nearest()
    model.learn(3, callback)
    model.save(tmp_path / "model")
    model = A2C.load(tmp_path / "model", env=squares(5), device="cpu")
    model.learn(3, callback, reset_num_timesteps=False)
    assert model.rollout_buffer.rewards.ravel() == pytest.approx([FIRST, SECOND, THIRD])


def test_a_callback_may_move_on_to_another_environment():
    callback = nearest()
    learned_rewards(squares(5), callback)
    assert learned_rewards(squares(3, 3), callback)[:, 0].tolist() == [FIRST, FIRST]


def test_a_new_callback_may_join_running_episodes():
    model = frozen_model(squares(5), n_steps=3)
    model.learn(3)
    model.learn(3, nearest(), reset_num_timesteps=False)
    assert model.rollout_buffer.rewards.ravel() == pytest.approx([0, FIFTH, FIRST])


def test_the_log_shows_the_mean_bonus_of_the_episodes_that_ended_in_the_rollout():
    model, log = frozen_model(squares(3, 4), n_steps=2), Log()
    model.set_logger(Logger(None, [log]))
    model.learn(4 * 2 * 2, nearest(psi=0.3), log_interval=1)
    # steps 1-2: none; 3-4: one of each; 5-6: slot 0's second; 7-8: slot 1's second
    three, four = SECOND + THIRD, SECOND + THIRD + FOURTH
    assert log.column("rollout/ep_oem_mean") == [
        None,
        pytest.approx((three + four) / 2, rel=1e-5),
        pytest.approx(three, rel=1e-5),
        pytest.approx(four, rel=1e-5),
    ]


def test_verbose_tells_which_bonus_is_given(capsys):
    started(nearest(verbose=1), n_slots=1)
    started(nearest(verbose=1, psi=0.3), n_slots=1)
    assert capsys.readouterr().out.splitlines() == [
        "Learning from the NearestNeighbor bonus in place of the reward",
        "Learning from the NearestNeighbor bonus times 0.3 beside the reward",
    ]


def test_e2c_takes_the_nearest_neighbor_unless_told_otherwise():
    model = E2CMAPPO("MlpPolicy", None, _init_setup_model=False, oem_kwargs={"psi": 0.1})
    assert model.oem_kwargs["estimator"] == "nearest_neighbor"
    assert model.oem_kwargs["psi"] == 0.1


@pytest.mark.parametrize("algorithm", [MAPPO, E2CMAPPO])
def test_mappo_learns_from_the_bonus_and_reports_the_extrinsic_return(algorithm, two_on_a_line):
    # every observation is "something, something, something": visits 1 to 4 of each episode
    env = share_parameters(lambda: two_on_a_line(length=4, end="terminated"), n_worlds=2)
    oem: dict[str, Any] = {"estimator": "visit_count"}
    extra = {"oem_kwargs": oem} if algorithm is E2CMAPPO else {}
    callback = OEMRewardCallback(**oem) if algorithm is MAPPO else None
    model, log = algorithm("MlpPolicy", env, n_steps=8, batch_size=32, device="cpu", **extra), Log()
    model.set_logger(Logger(None, [log]))
    model.learn(2 * 8 * 4, callback)
    episode = np.array([1, 1 / 2, 1 / 3, 1 / 4], np.float32)
    rewards = model.rollout_buffer.rewards.reshape(8, 4)
    assert all(slot.tolist() == [*episode, *episode] for slot in rewards.T)
    assert log.column("rollout/ep_oem_mean") == [pytest.approx(25 / 12)] * 2
    # team returns lie between all slow and all fast, far from the bonus
    assert all(8 <= team_return <= 16 for team_return in log.column("rollout/ep_rew_mean"))


class Constant:
    """An estimator of somebody else."""

    def reset(self, n_slots: int) -> None:
        self.n_slots = n_slots

    def score(self, observations: np.ndarray) -> np.ndarray:
        return np.full(self.n_slots, 0.25)

    def forget(self, slots: np.ndarray) -> None:
        pass


def test_any_object_with_the_three_methods_is_an_estimator():
    assert isinstance(Constant(), EntropyEstimator)
    assert learned_rewards(squares(3), OEMRewardCallback(Constant()))[0].tolist() == [0.25] * 6


def test_estimators_are_made_by_name():
    assert nearest().estimator.k == 1
    assert OEMRewardCallback("visit_count").estimator.quantization == 1
    assert OEMRewardCallback("visit_count", {"empty": 0.0}).estimator.empty == 0


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("knn",), ValueError, "Unknown estimator 'knn': choose from visit_count, nearest_nei"),
        ((NearestNeighbor,), TypeError, "an object with the methods reset, score and forget"),
        ((5,), TypeError, "an object with the methods reset, score and forget, got 5"),
        ((VisitCount(), {"k": 1}), ValueError, "{'k': 1} have no effect on .* VisitCount"),
        (("nearest_neighbor", {"k": 0}), ValueError, "k must be an integer of at least 1, got 0"),
        (("visit_count", None, "0.3"), ValueError, "psi must be a finite number .* got '0.3'"),
        (("visit_count", None, math.nan), ValueError, "psi must be a finite number"),
    ],
)
def test_bad_arguments_are_explained(arguments, error, message):
    with pytest.raises(error, match=message):
        OEMRewardCallback(*arguments)


def test_off_policy_algorithms_are_refused():
    model = DQN("MlpPolicy", squares(3), buffer_size=10, device="cpu")
    with pytest.raises(TypeError, match="DQN is not an on-policy algorithm"):
        model.learn(1, nearest())


def started(callback: OEMRewardCallback, n_slots: int) -> OEMRewardCallback:
    """A callback at the start of learning in a model that is not there."""
    callback.model = SimpleNamespace(
        _last_episode_starts=np.ones(n_slots, bool),
        get_vec_normalize_env=lambda: None,
        num_timesteps=0,
    )
    callback.on_training_start({}, {})
    return callback


def step(callback: OEMRewardCallback, new_obs: Any, **others: Any) -> np.ndarray:
    """Rewards after one step."""
    n_slots = len(callback.episode_bonuses)
    variables = {
        "new_obs": new_obs,
        "rewards": np.zeros(n_slots, np.float32),
        "dones": np.zeros(n_slots, bool),
        "infos": [{} for _ in range(n_slots)],
    } | others
    callback.update_locals(variables)
    callback.on_step()
    return variables["rewards"]


@pytest.mark.parametrize(
    ("others", "error", "message"),
    [
        ({"rewards": None}, TypeError, 'does not show its callbacks an array "rewards"'),
        ({"rewards": np.zeros(2, int)}, TypeError, "but that is int64: return float rewards"),
        ({"rewards": np.broadcast_to(0.0, 2)}, TypeError, "but that is float64, read-only"),
        ({"new_obs": {"position": np.zeros((2, 1))}}, TypeError, "observations are dictionaries"),
        ({"dones": np.array([False, True])}, ValueError, r"terminal_observation.* slots \[1\]"),
        (
            {"infos": [{"novelty_observation": np.zeros(1)}, {}]},
            ValueError,
            r"novelty_observation.* missing for slots \[1\] of 2: .* at every step",
        ),
    ],
)
def test_what_an_algorithm_or_environment_fails_to_give_is_explained(others, error, message):
    callback = started(nearest(), n_slots=2)
    with pytest.raises(error, match=message):
        step(callback, **({"new_obs": np.zeros((2, 1))} | others))


def test_vec_normalize_must_be_the_last_wrapper():
    callback = started(nearest(), n_slots=1)
    normalize = SimpleNamespace(get_original_obs=lambda: np.zeros((1, 2)))
    callback.model.get_vec_normalize_env = lambda: normalize
    with pytest.raises(ValueError, match=r"shape \(1, 8\) and VecNormalize's have shape \(1, 2\)"):
        step(callback, np.zeros((1, 8)))


def test_observations_stay_as_the_algorithm_knows_them():
    callback = started(nearest(), n_slots=1)
    new_obs = np.array([[5.0]], np.float32)
    infos = [{"terminal_observation": np.array([9.0])}]
    step(callback, new_obs, dones=np.array([True]), infos=infos)
    assert new_obs.tolist() == [[5.0]]
