"""One record for each world's episode."""

import csv
import json

import gymnasium as gym
import numpy as np
import pytest
from conftest import FAST, SLOW, TwoOnALine
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from sb3_e2c import MAPPO, evaluate_team
from sb3_e2c.monitor import TeamMonitor
from sb3_e2c.vec_env import share_parameters


def monitored(n_worlds=2, filename=None, info_keywords=(), **parameters):
    venv = share_parameters(lambda: TwoOnALine(**parameters), n_worlds)
    return TeamMonitor(venv, filename, info_keywords)


def run(venv, n_steps, actions=(SLOW, FAST)):
    venv.reset()
    for _ in range(n_steps):
        outcome = venv.step(np.tile(actions, venv.num_envs // len(actions)))
    return outcome


def episodes(venv, n_steps, actions=(SLOW, FAST)):
    """Records in the infos of the last of some steps, without their times."""
    records = [info.get("episode") for info in run(venv, n_steps, actions)[3]]
    return [record and {k: v for k, v in record.items() if k != "t"} for record in records]


def test_every_slot_of_an_ended_world_has_the_record_of_the_team():
    # Four steps: agent_0 slow earns 4, agent_1 fast 8 at cost 4.
    record = {"r": 12.0, "l": 4, "cost": 4.0}
    assert episodes(monitored(), 4) == [record] * 4


def test_there_is_no_record_before_the_end():
    assert episodes(monitored(), 3) == [None] * 4


def test_a_shared_reward_counts_once():
    # Both get 1 + 2 = 3 at each of four steps.
    assert episodes(monitored(shared=True), 4)[0]["r"] == 12


def test_the_team_cost_is_the_sum_or_the_maximum_over_agents_of_each_step():
    both = {"agent_costs": (1.0, 3.0), "length": 2}
    assert episodes(monitored(**both), 2, (FAST, FAST))[0]["cost"] == 8  # 2 (1 + 3)
    assert episodes(monitored(**both, team_cost="max"), 2, (FAST, FAST))[0]["cost"] == 6  # 2 · 3


def test_several_costs_are_numbered_and_none_leaves_no_trace():
    # The second cost is twice the first.
    assert episodes(monitored(n_costs=2), 4)[0] == {"r": 12, "l": 4, "cost_0": 4, "cost_1": 8}
    assert episodes(monitored(n_costs=0), 4)[0] == {"r": 12, "l": 4}


def test_worlds_end_on_their_own_and_begin_again_at_zero():
    venv = monitored()
    venv.set_options([{"length": 1}] * 2 + [{"length": 3}] * 2)
    record = {"r": 3, "l": 1, "cost": 1}
    assert episodes(venv, 3) == [record] * 2 + [{"r": 9, "l": 3, "cost": 3}] * 2


def test_a_reset_forgets_the_running_episode():
    venv = monitored()
    run(venv, 3)
    assert episodes(venv, 4)[0] == {"r": 12, "l": 4, "cost": 4}


def test_rewards_edited_by_a_callback_do_not_change_the_record():
    venv = monitored()
    venv.reset()
    for _ in range(4):
        _, rewards, _, infos = venv.step(np.tile([SLOW, FAST], 2))
        rewards[:] = -100
    assert infos[0]["episode"]["r"] == 12


@pytest.mark.parametrize("monitor_outside", [True, False])
def test_normalized_rewards_are_recorded_in_their_own_unit(monitor_outside):
    venv = share_parameters(TwoOnALine, 2)
    venv = TeamMonitor(VecNormalize(venv)) if monitor_outside else VecNormalize(TeamMonitor(venv))
    assert episodes(venv, 4)[0]["r"] == 12


def test_the_file_has_one_row_for_each_episode_of_a_world(tmp_path):
    venv = monitored(3, str(tmp_path / "train"), length=2, n_costs=2)
    run(venv, 1)
    assert not list(tmp_path.iterdir())  # the costs' columns are not known before the first end
    run(venv, 4)
    venv.close()
    header, *rows = (tmp_path / "train.monitor.csv").read_text().splitlines()
    assert json.loads(header[1:])["env_id"] == "two_on_a_line_v0"
    table = list(csv.DictReader(rows))
    assert list(table[0]) == ["r", "l", "t", "cost_0", "cost_1"]
    assert [(float(row["r"]), float(row["cost_1"])) for row in table] == [(6, 4)] * 6
    assert len(load_results(str(tmp_path))) == 6


@pytest.mark.parametrize("wrap", [VecMonitor, VecNormalize, VecCheckNan])
def test_episodes_are_teams_whatever_the_environment_was_wrapped_in(wrap):
    env = wrap(share_parameters(lambda: TwoOnALine(length=4), 2))
    model = MAPPO("MlpPolicy", env, n_steps=8, batch_size=16, device="cpu").learn(32)
    assert "cost" in model.ep_info_buffer[0]
    assert model.ep_info_buffer[0]["r"] >= 8  # both agents', 1 to 2 a step each


def test_more_of_the_last_info_can_be_recorded():
    venv = monitored(info_keywords=("critic_state",), critic_state=True)
    assert episodes(venv, 4)[0]["critic_state"] == 1.0  # t / length


@pytest.mark.parametrize(("algorithm", "entries_of_an_episode"), [(MAPPO, 1), (PPO, 2)])
def test_mappo_logs_one_entry_for_each_episode_of_a_world(algorithm, entries_of_an_episode):
    settings = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "seed": 0, "device": "cpu"}
    model = algorithm("MlpPolicy", monitored(), **settings)
    model.learn(8 * 4)
    # two worlds, two episodes of four steps; PPO takes every agent for an environment
    assert len(model.ep_info_buffer) == 4 * entries_of_an_episode
    assert {info["l"] for info in model.ep_info_buffer} == {4}


def test_sb3s_own_evaluation_comes_to_an_end():
    settings = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "seed": 0, "device": "cpu"}
    model = MAPPO("MlpPolicy", monitored(), **settings)
    returns, lengths = evaluate_policy(
        model, model.get_env(), n_eval_episodes=4, return_episode_rewards=True
    )
    team = evaluate_team(model, model.get_env(), 1, deterministic=True)
    assert returns == [team.returns[0]] * 4
    assert lengths == [4] * 4


def test_an_environment_without_teams_is_refused():
    with pytest.raises(TypeError, match="type DummyVecEnv, which does not say which slots form"):
        TeamMonitor(DummyVecEnv([lambda: gym.make("CartPole-v1")]))


class Odd(TwoOnALine):
    """Costs that are not the same number of numbers everywhere."""

    batched = None
    odd_costs = staticmethod(lambda agent, t: 1.0)

    def step(self, actions):
        *rest, infos = super().step(actions)
        return *rest, {a: self.odd_costs(a, self.t) for a in infos}


@pytest.mark.parametrize(
    ("info", "message"),
    [
        (lambda a, t: {"cost": 1.0} if a == "agent_0" else {}, "'agent_1': 'nothing'"),
        (lambda a, t: {"cost": [1.0] if a == "agent_0" else [1.0, 2.0]}, "report different costs"),
        (lambda a, t: {"cost": "much"}, "'agent_0': 'much'"),
        (lambda a, t: {"cost": [1.0] * t}, "report 2 costs .* now and reported 1 before"),
        (lambda a, t: {"cost": 1.0} if t == 2 else {}, "report 1 costs .* now and reported 0 be"),
    ],
)
def test_costs_that_do_not_fit_together_are_explained(info, message):
    class Costs(Odd):
        odd_costs = staticmethod(info)

    with pytest.raises(ValueError, match=message):
        run(TeamMonitor(share_parameters(Costs, 1)), 2)
