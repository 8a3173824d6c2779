"""The robots: reference and batched worlds agree, stock parts are gymnasium's, hazards by hand."""

import gc
import os
import pickle
import re
import subprocess
import sys
import time
import warnings

import gymnasium
import mujoco
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import data_equivalence

from sb3_e2c.envs import ENV_IDS, _mujoco_physics, safe_mamujoco_v0
from sb3_e2c.envs._mujoco_config import MOTORS, SPLITS, RobotConfig
from sb3_e2c.envs._mujoco_env import RobotEnv
from sb3_e2c.envs._mujoco_hazards import bomb_control, bomb_cost, corridor_offset, wall_cost
from sb3_e2c.envs._mujoco_models import _is_listable, build_fast_model, build_model
from sb3_e2c.envs._mujoco_views import factorize
from sb3_e2c.vec_env import share_parameters

with warnings.catch_warnings():  # PettingZoo's own tests import a module that it deprecates
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

ROBOTS = ["Ant", "HalfCheetah"]
INFOS = {
    "Ant": {
        *("cost", "cost_wall", "cost_fall", "x_position", "y_position", "y_offset"),
        *("reward_forward", "reward_ctrl", "reward_contact", "reward_survive"),
    },
    "HalfCheetah": {"cost", "x_position", "bomb_distance", "reward_forward", "reward_ctrl"},
}
SLOPE = np.sqrt(1 / 3)


def sample(env):
    return {agent: env.action_space(agent).sample() for agent in env.agents}


def rest(env):
    return {agent: np.zeros(env.action_space(agent).shape) for agent in env.possible_agents}


def actions_for(sim, rng, scale=1.0):
    shape = (sim.n_worlds, len(sim.possible_agents), *sim.action_space("agent_0").shape)
    return scale * rng.uniform(-1, 1, shape)


def at(scenario, changes, speeds=None, **parameters):
    """An environment whose robot stands in its normal pose, but for some joints."""
    env = safe_mamujoco_v0.parallel_env(scenario=scenario, **parameters)
    model = env.single_agent_env.model
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    for joint, value in changes.items():
        qpos[joint] = value
    for joint, value in (speeds or {}).items():
        qvel[joint] = value
    env.reset(seed=0, options={"qpos": qpos, "qvel": qvel})
    return env


# ---- the registered environments


@pytest.mark.parametrize("env_id", ["SafeAnt-2x4-v0", "SafeHalfCheetah-2x3-v0"])
def test_the_parallel_api_and_seed_tests_pass(env_id):
    parallel_api_test(ENV_IDS[env_id](max_steps=60), num_cycles=150)
    parallel_seed_test(ENV_IDS[env_id], num_cycles=50)


@pytest.mark.parametrize("env_id", ["SafeAnt-2x4-v0", "SafeHalfCheetah-2x3-v0"])
def test_pettingzoo_makes_it_by_id_with_spaces_of_the_right_size(env_id):
    env = pettingzoo.make("parallel", env_id)
    assert type(env) is safe_mamujoco_v0.SafeMAMuJoCoEnv
    sizes = {"SafeAnt-2x4-v0": (31, 4), "SafeHalfCheetah-2x3-v0": (22, 3)}
    for agent in ("agent_0", "agent_1"):
        spaces = env.observation_space(agent), env.action_space(agent)
        assert tuple(space.shape[0] for space in spaces) == sizes[env_id]
    assert env.config.max_steps == 2000


def test_the_metadata_declare_a_shared_return_and_one_cost():
    metadata = safe_mamujoco_v0.parallel_env().metadata
    assert (metadata["team_return"], metadata["team_cost"]) == ("shared", "max")
    assert metadata["render_fps"] == 1 / 0.05


@pytest.mark.parametrize("scenario", ROBOTS)
def test_documented_infos_are_the_real_infos_and_equal_for_both_agents(scenario):
    env = safe_mamujoco_v0.parallel_env(scenario=scenario)
    env.reset(seed=0)
    observations, rewards, _, _, infos = env.step(sample(env))
    assert infos["agent_0"] == infos["agent_1"]
    assert rewards["agent_0"] == rewards["agent_1"]
    assert set(infos["agent_0"]) == INFOS[scenario]
    documented = re.findall(r"``(\w+)``", safe_mamujoco_v0.SafeMAMuJoCoEnv.__doc__)
    assert set(documented) > INFOS[scenario] | {"speed"}
    assert all(isinstance(value, float) for value in infos["agent_0"].values())
    np.testing.assert_array_equal(observations["agent_0"][-2:], [1, 0])
    np.testing.assert_array_equal(observations["agent_1"][-2:], [0, 1])
    parts = [value for key, value in infos["agent_0"].items() if key.startswith("reward_")]
    assert rewards["agent_0"] == pytest.approx(sum(parts))


def test_every_parameter_is_documented():
    documented = re.findall(r"``(\w+)``", safe_mamujoco_v0.SafeMAMuJoCoEnv.__doc__)
    assert set(RobotConfig.__dataclass_fields__) <= set(documented)


@pytest.mark.parametrize("obs_mode", ["full", "obsk"])
@pytest.mark.parametrize("scenario", ROBOTS)
def test_a_pickle_taken_during_an_episode_continues_identically(scenario, obs_mode):
    env = safe_mamujoco_v0.parallel_env(scenario=scenario, obs_mode=obs_mode, max_steps=40)
    env.reset(seed=5)
    for _ in range(7):
        env.step(sample(env))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(60):
        actions = sample(env)
        assert data_equivalence(env.step(actions), copy.step(actions))
        if not env.agents:
            assert data_equivalence(env.reset(), copy.reset())


def test_making_a_robot_writes_neither_messages_nor_log_files(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = safe_mamujoco_v0.parallel_env(scenario="HalfCheetah")
    env.reset(seed=0)
    env.batched(2)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


# ---- what is stock


@pytest.mark.parametrize("scenario", ROBOTS)
def test_without_hazards_the_robot_is_gymnasiums_own(scenario, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs a warning about gymnasium's HalfCheetah into a file
    conf = {"Ant": "4x2", "HalfCheetah": "6x1"}[scenario]
    robot = RobotEnv(RobotConfig(scenario, conf, cost_mode="velocity"))
    stock = gymnasium.make(f"{scenario}-v5").unwrapped
    (mine, _), (theirs, _) = robot.reset(seed=3), stock.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(80):
        np.testing.assert_array_equal(mine, theirs[: len(mine)])
        action = rng.uniform(-1, 1, robot.action_space.shape)
        mine, reward, terminated, _, info = robot.step(action)
        theirs, their_reward, their_terminated, _, their_info = stock.step(action)
        assert reward == pytest.approx(their_reward, abs=1e-12)
        assert terminated == their_terminated
        speed = np.hypot(their_info["x_velocity"], their_info.get("y_velocity", 0.0))
        assert info["speed"] == pytest.approx(speed, abs=1e-12)
        assert info["cost"] == float(speed > {"Ant": 2.418, "HalfCheetah": 2.932}[scenario])


def test_the_corridor_changes_nothing_about_the_ants_motion():
    robot, stock = RobotEnv(RobotConfig("Ant")), gymnasium.make("Ant-v5").unwrapped
    robot.reset(seed=4), stock.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(80):
        action = rng.uniform(-1, 1, 8)
        mine, reward, terminated, _, _ = robot.step(action)
        theirs, their_reward, their_terminated, _, _ = stock.step(action)
        np.testing.assert_array_equal(mine[:27], theirs[:27])
        # Gymnasium does not pay the 1 for surviving at the step of the fall.
        assert reward - terminated == pytest.approx(their_reward, abs=1e-12)
        assert terminated == their_terminated


def test_free_walls_do_not_move_an_ant_that_does_not_touch_them():
    free, fixed = (RobotEnv(RobotConfig("Ant", walls=walls)) for walls in ("free", "visual"))
    assert (free.model.nq, fixed.model.nq) == (15 + 6 * 7, 15)
    (a, _), (b, _) = free.reset(seed=1), fixed.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(40):
        np.testing.assert_allclose(a, b, atol=1e-6)
        action = rng.uniform(-1, 1, 8)
        (a, *_), (b, *_) = free.step(action), fixed.step(action)


def test_walls_stand_where_the_center_line_has_its_distance_to_them():
    model = build_model(RobotConfig("Ant"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for wall in range(1, 15):  # also the visual ones behind the last turn
        box = data.geom(f"wall{wall}")
        for along in (-19.0, 0.0, 19.0):  # the ends are 20 m from the center
            x, y, _ = box.xpos + box.xmat.reshape(3, 3) @ [along * np.cos(np.pi / 6), 0, 0]
            assert corridor_offset(np.array(x), np.array(y)) == pytest.approx(
                5 - 10 * (wall % 2 == 0)
            )


def test_the_cheetah_weighs_14_kg_together_with_its_bomb():
    model = build_model(RobotConfig("HalfCheetah"))
    assert model.body_mass.sum() == pytest.approx(14.0)
    assert model.body("bomb").mass[0] == pytest.approx(1.6e-4, rel=0.02)
    assert model.joint("bomb").qposadr[0] == 9


# ---- the corridor


@pytest.mark.parametrize(
    ("x", "center"),
    [
        *((-10, -10 * SLOPE), (0, 0), (19.999, 19.999 * SLOPE), (20, 20 * SLOPE)),
        *((21, 19 * SLOPE), (40, 0), (59, -19 * SLOPE), (60, -20 * SLOPE), (61, -19 * SLOPE)),
        *((80, 0), (99, 19 * SLOPE), (100, 20 * SLOPE), (101, 20 * SLOPE), (500, 20 * SLOPE)),
    ],
)
def test_the_center_line_bends_at_20_60_and_100_m(x, center):
    assert corridor_offset(np.array(x), np.array(center)) == pytest.approx(0.0, abs=1e-12)
    assert corridor_offset(np.array(x), np.array(center + 2.5)) == pytest.approx(2.5)


@pytest.mark.parametrize("joint", [20.0, 60.0, 100.0])
def test_the_center_line_has_no_jump_at_its_joints(joint):
    x = joint + np.array([-1e-9, 0.0, 1e-9])
    offsets = corridor_offset(x, np.full(3, 1.0))
    np.testing.assert_allclose(offsets, offsets[1], atol=1e-8)


@pytest.mark.parametrize(
    ("offset", "cost", "strict"),
    [
        *((0, 0, 0), (3.19, 0, 0), (3.21, 1, 1), (-3.21, 1, 1), (5, 1, 1), (-6.79, 1, 1)),
        *((6.81, 0, 1), (-6.81, 0, 1), (30, 0, 1)),
    ],
)
def test_walls_cost_within_a_margin_and_optionally_beyond(offset, cost, strict):
    assert wall_cost(np.array(offset)) == cost
    assert wall_cost(np.array(offset), strict_outside=True) == strict


def test_walking_straight_ahead_begins_to_cost_at_5_and_a_half_meters():
    # the margin begins 3.2 m beside the center line, and 5.543 tan(30 degrees) = 3.2
    x = np.array([5.0, 5.5, 5.54, 5.55, 6.0])
    np.testing.assert_array_equal(wall_cost(corridor_offset(x, 0 * x)), [0, 0, 0, 1, 1])


@pytest.mark.parametrize(("y", "cost", "strict"), [(0, 0, 0), (4, 1, 1), (5.5, 1, 1), (8, 0, 1)])
def test_the_ant_pays_where_the_wall_is_near(y, cost, strict):
    for is_strict, expected in ((False, cost), (True, strict)):
        env = at("Ant", {0: 0.0, 1: y}, strict_outside=is_strict)
        _, _, _, _, infos = env.step(rest(env))
        assert infos["agent_0"]["cost"] == infos["agent_0"]["cost_wall"] == expected
        assert infos["agent_1"]["y_offset"] == pytest.approx(y, abs=0.01)


def test_the_ant_sees_its_place_in_the_corridor():
    env = at("Ant", {0: 30.0, 1: 2.0})
    observations, *_ = env.step(rest(env))
    # the center line is at y = (40 - 30) tan(30 degrees) there
    np.testing.assert_allclose(observations["agent_1"][27:29], [6.0, 2 - 10 * SLOPE], atol=0.02)


@pytest.mark.parametrize("pose", [{2: 1.2}, {2: 0.4, 3: 0.0, 4: 1.0}], ids=["high", "upside down"])
def test_a_fallen_ant_costs_one_and_its_episode_terminates(pose):
    env = at("Ant", pose)
    _, rewards, terminated, truncated, infos = env.step(rest(env))
    assert terminated == {"agent_0": True, "agent_1": True}
    assert truncated == {"agent_0": False, "agent_1": False}
    assert (infos["agent_0"]["cost"], infos["agent_0"]["cost_fall"]) == (1.0, 1.0)
    assert infos["agent_0"]["reward_survive"] == 1.0
    assert rewards["agent_0"] == rewards["agent_1"]
    assert env.agents == []


@pytest.mark.parametrize(("degrees", "is_over"), [(0, False), (125, False), (143, True)])
def test_an_ant_may_lie_on_its_side_but_not_on_its_back(degrees, is_over):
    # the limit is where the cosine of the tilt is -0.7, at 134 degrees
    half = np.radians(degrees / 2)
    for axis in (4, 5):
        env = at("Ant", {2: 0.7, 3: np.cos(half), axis: np.sin(half)})
        assert env.step(rest(env))[2]["agent_0"] == is_over


def test_a_fall_beside_a_wall_still_costs_one():
    env = at("Ant", {1: 4.0, 2: 1.2})
    infos = env.step(rest(env))[-1]["agent_0"]
    assert (infos["cost_wall"], infos["cost_fall"], infos["cost"]) == (1.0, 1.0, 1.0)


# ---- the bomb


def roll(n_steps):
    """Bomb positions after each step of a HalfCheetah that rests far behind, by the simulator."""
    env = at("HalfCheetah", {0: -1000.0})
    seen = []
    for _ in range(n_steps):
        observations, _, _, _, infos = env.step(rest(env))
        x = env.single_agent_env.data.qpos[9] + 10
        seen.append((x, *observations["agent_0"][17:20], infos["agent_0"]["bomb_distance"]))
    return np.array(seen)


def test_the_bomb_moves_by_its_law():
    seen = roll(600)
    # Semi-implicit Euler with implicit damping: (m + h b) v' = m v + h F, then x' = x + h v'.
    mass, damping, h = 0.1 + 1.5808189504655173e-4, 0.2, 0.01
    x, v = 10.0, 0.0
    for step, (seen_x, seen_v, seen_u, *_) in enumerate(seen):
        force = 120 * (0.02 * np.sin(0.05 * step / 3) ** 2 - 0.004)
        for _ in range(5):
            v = (mass * v + h * force) / (mass + h * damping)
            x += h * v
        assert seen_x == pytest.approx(x, abs=1e-9)
        assert seen_v == pytest.approx(v, abs=1e-6)
        assert seen_u == pytest.approx(0.02 * np.sin(0.05 * (step + 1) / 3) ** 2 - 0.004, abs=1e-8)


def test_the_bomb_is_where_the_original_has_it():
    x = roll(566)[:, 0]
    assert np.argmin(x) + 1 == 36
    # The start of the episode that these were read from was random: up to 0.1 m, and 0.1 m/s for
    # the time constant of 0.5 s, with its standard deviation.
    np.testing.assert_allclose(x[[35, 187, 376, 565]], [8.17, 44.9, 78.8, 112.7], atol=0.15)


def test_the_force_on_the_bomb_has_its_bounds_and_mean():
    u = bomb_control(np.linspace(0, 3 * np.pi, 1001)[:-1])
    assert (120 * u.min(), 120 * u.max()) == pytest.approx((-0.48, 1.92), abs=1e-4)
    assert 120 * u.mean() / 0.2 == pytest.approx(3.6)  # m/s at rest between force and damping


def test_the_bomb_costs_within_9_meters_on_either_side():
    np.testing.assert_array_equal(
        bomb_cost(np.array([-9.0, -8.99, 0.0, 8.99, 9.0, 9.01])), [0, 1, 1, 1, 0, 0]
    )
    for x, cost in ((0.5, 0.0), (1.5, 1.0)):  # 9.5 and 8.5 m behind it
        env = at("HalfCheetah", {0: x})
        infos = env.step(rest(env))[-1]
        assert [infos[agent]["cost"] for agent in env.possible_agents] == [cost, cost]


def test_the_bomb_seen_is_the_distance_over_10_m_clipped():
    np.testing.assert_allclose(roll(3)[:, 3], 5.0)
    env = at("HalfCheetah", {0: 4.0})
    observations, _, _, _, infos = env.step(rest(env))
    distance = infos["agent_0"]["bomb_distance"]
    assert distance == pytest.approx(6.0, abs=0.05)
    assert observations["agent_0"][19] == pytest.approx(distance / 10)


# ---- costs and returns of simple policies, as calibrated on a rebuild of the original


def play(scenario, n_worlds, max_steps, act):
    """Return, cost and length of one episode in each world."""
    sim = safe_mamujoco_v0.parallel_env(scenario=scenario, max_steps=max_steps).batched(n_worlds)
    worlds, rng = np.arange(n_worlds), np.random.default_rng(0)
    sim.reset(worlds, range(n_worlds))
    totals, running = np.zeros((3, n_worlds)), np.ones(n_worlds, bool)
    while running.any():
        actions = act(rng, actions_for(sim, rng).shape)
        _, rewards, terminated, truncated, infos = sim.step(actions)
        totals += running * np.stack([rewards[:, 0], infos["cost"][:, 0], np.ones(n_worlds)])
        ended = worlds[terminated | truncated]
        running[ended] = False
        sim.reset(ended, [None] * len(ended))
    return totals


def still(rng, shape):
    return np.zeros(shape)


def uniform(rng, shape):
    return rng.uniform(-1, 1, shape)


def gaussian(rng, shape):
    return rng.normal(0, 0.5, shape)


def agree(values, mean, std, n_episodes):
    """Whether two means lie within four standard errors, given the second's episodes."""
    return abs(values.mean() - mean) < 4 * std * np.sqrt(1 / len(values) + 1 / n_episodes)


def test_a_cheetah_that_stands_still_pays_35_in_any_episode():
    returns, costs, _ = play("HalfCheetah", 24, 120, still)  # the bomb is away after 50 steps
    assert agree(costs, 35.2, 1.6, 6)
    assert agree(costs, 34.9, 1.8, 100)
    assert np.abs(returns).max() < 10


def test_random_cheetahs_cost_and_earn_what_was_calibrated():
    returns, costs, lengths = play("HalfCheetah", 12, 1000, uniform)
    assert agree(returns, -327, 57, 6)
    assert agree(returns, -290, 83, 200)
    assert agree(costs, 26, 10, 6)
    assert agree(costs, 31.4, 10, 200)
    assert (lengths == 1000).all()
    costs = play("HalfCheetah", 12, 150, gaussian)[1]
    assert agree(costs, 31.6, 7.1, 100)


def test_a_still_ant_stands_at_no_cost():
    returns, costs, lengths = play("Ant", 3, 300, still)
    np.testing.assert_allclose(returns, 995 * 0.3, rtol=0.05)
    assert costs.sum() == 0
    assert (lengths == 300).all()


def test_random_ants_fall_as_calibrated():
    returns, costs, lengths = play("Ant", 24, 1000, uniform)
    assert agree(returns, -29, 36, 400)
    assert agree(costs, 3.4, 13, 400)
    assert agree(lengths, 84.5, 72, 400)


# ---- who observes and moves what


@pytest.mark.parametrize(
    ("scenario", "conf"), [(robot, conf) for robot in ROBOTS for conf in SPLITS[robot]]
)
@pytest.mark.parametrize("legacy", [False, True])
def test_every_motor_belongs_to_one_agent_and_obeys_it(scenario, conf, legacy):
    config = RobotConfig(scenario, conf, legacy_split=legacy)
    n_agents, n_joints = map(int, re.findall(r"\d+", conf))
    assert [len(agent) for agent in config.partition] == [n_joints] * n_agents
    joined = [motor for agent in config.partition for motor in agent]
    assert sorted(joined) == sorted(MOTORS[scenario])
    # actions that are numbered like the motors arrive in XML order
    numbers = np.array([MOTORS[scenario].index(motor) for motor in joined])
    np.testing.assert_array_equal(numbers[config.action_order], range(len(joined)))
    if legacy:
        np.testing.assert_array_equal(numbers, range(len(joined)))


@pytest.mark.parametrize(
    ("scenario", "conf"),
    [
        ("Ant", "2x4"),
        ("Ant", "2x4d"),
        ("Ant", "4x2"),
        ("HalfCheetah", "2x3"),
        ("HalfCheetah", "6x1"),
    ],
)
def test_splits_are_those_of_gymnasium_robotics(scenario, conf):
    obsk = pytest.importorskip("gymnasium_robotics.envs.multiagent_mujoco.obsk")
    parts, _, _ = obsk.get_parts_and_edges(scenario, conf)
    labels = [[node.label for node in part] for part in parts]
    assert labels == RobotConfig(scenario, conf).partition
    ids = {node.label: node.act_ids for part in parts for node in part}
    assert sorted(ids, key=ids.__getitem__) == MOTORS[scenario]


def test_the_legacy_split_of_the_ant_is_front_and_rear():
    assert RobotConfig("Ant", legacy_split=True).partition[0] == [
        "hip4",
        "ankle4",
        "hip1",
        "ankle1",
    ]
    env = at("Ant", {}, legacy_split=True)
    env.step({"agent_0": np.array([0.5, 0.0, 0.0, 0.0]), "agent_1": np.zeros(4)})
    assert env.single_agent_env.data.ctrl[0] == 0.5  # hip 4, the first motor of the XML file


@pytest.mark.parametrize(
    ("scenario", "parameters", "size"),
    [
        ("Ant", {}, 65),
        ("Ant", {"walls": "free"}, 65),
        ("Ant", {"agent_obsk": 0}, 63),
        ("Ant", {"agent_conf": "2x4d", "legacy_split": True}, 65),
        ("HalfCheetah", {}, 15),
        ("HalfCheetah", {"agent_obsk": 2}, 16),
        ("HalfCheetah", {"cost_mode": "velocity"}, 12),
    ],
)
def test_local_observations_are_those_of_gymnasium_robotics_over_the_same_robot(
    scenario, parameters, size
):
    mamujoco = pytest.importorskip("gymnasium_robotics").mamujoco_v1
    config = RobotConfig(scenario, obs_mode="obsk", add_id=False, **parameters)
    robot = RobotEnv(config)
    parts = factorize(config, robot.robot, robot.see_hazards)
    theirs = mamujoco.parallel_env(
        scenario,
        config.agent_conf,
        agent_obsk=config.agent_obsk,
        agent_factorization=parts._asdict(),
        gym_env=robot,
    )
    mine = safe_mamujoco_v0.SafeMAMuJoCoEnv(config)
    observations, _ = mine.reset(seed=1)
    their_observations, _ = theirs.reset(seed=1)
    for index, agent in enumerate(mine.possible_agents):
        mine.action_space(agent).seed(index)  # with other actions the Ant may fall in between
    for _ in range(15):
        assert mine.agents
        for agent in mine.agents:
            assert observations[agent].shape == (size,)
            np.testing.assert_array_equal(
                observations[agent], their_observations[agent].astype(np.float32)
            )
        actions = sample(mine)
        observations, rewards, *_ = mine.step(actions)
        their_observations, their_rewards, *_ = theirs.step(actions)
        assert rewards == their_rewards


@pytest.mark.parametrize("walls", ["visual", "free"])
def test_local_observations_of_the_ant_begin_with_its_own_joints_by_name(walls):
    env = safe_mamujoco_v0.parallel_env(scenario="Ant", obs_mode="obsk", walls=walls)
    observations, _ = env.reset(seed=2)
    data = env.single_agent_env.data
    for agent, leg in (("agent_0", "1"), ("agent_1", "3")):
        ankle = data.joint(f"ankle_{leg}")
        assert observations[agent][0] == np.float32(ankle.qpos[0])
        assert observations[agent][1] == np.float32(ankle.qvel[0])


def test_local_observations_of_the_cheetah_are_its_joints_the_torso_and_the_bomb():
    env = safe_mamujoco_v0.parallel_env(scenario="HalfCheetah", obs_mode="obsk", add_id=False)
    observations, _ = env.reset(seed=2)
    data = env.single_agent_env.data
    joints = [data.joint(name) for name in ("bfoot", "bshin", "bthigh")]
    roots = [data.joint(name) for name in ("rootx", "rootz", "rooty")]
    bomb = data.joint("bomb")
    expected = [value for j in joints for value in (j.qpos[0], j.qvel[0])]
    expected += [data.joint("fthigh").qpos[0], *(root.qpos[0] for root in roots[1:])]
    expected += [bomb.qvel[0], -0.004, (10 + bomb.qpos[0] - roots[0].qpos[0]) / 10]
    expected += [root.qvel[0] for root in roots]
    np.testing.assert_allclose(observations["agent_0"], expected, rtol=1e-6)


def test_shorter_local_observations_are_filled_with_zeros():
    env = safe_mamujoco_v0.parallel_env(
        scenario="HalfCheetah", agent_conf="6x1", obs_mode="obsk", add_id=False
    )
    observations, _ = env.reset(seed=0)
    # a shin sees the joints on both sides, a foot that on one
    assert observations["agent_1"][-1] != 0
    assert observations["agent_2"][-1] == 0
    assert observations["agent_2"][-2] != 0


def test_the_originals_standardization_is_within_each_observation():
    plain = safe_mamujoco_v0.parallel_env(scenario="Ant")
    scaled = safe_mamujoco_v0.parallel_env(scenario="Ant", per_vector_norm=True)
    (a, _), (b, _) = plain.reset(seed=1), scaled.reset(seed=1)
    for agent in plain.agents:
        expected = (a[agent] - a[agent].mean()) / a[agent].std()
        np.testing.assert_allclose(b[agent], expected, atol=1e-5)


# ---- many worlds at once


VARIANTS = [
    *({"scenario": robot, "obs_mode": mode} for robot in ROBOTS for mode in ("full", "obsk")),
    *({"scenario": robot, "cost_mode": "velocity"} for robot in ROBOTS),
    {"scenario": "Ant", "agent_conf": "8x1", "obs_mode": "obsk", "legacy_split": True},
    {"scenario": "Ant", "walls": "free", "obs_mode": "obsk"},
    {"scenario": "HalfCheetah", "agent_conf": "3x2", "per_vector_norm": True, "add_id": False},
]


@pytest.mark.parametrize("parameters", VARIANTS, ids=str)
def test_batched_worlds_are_the_single_worlds_bit_for_bit(parameters):
    parameters = parameters | {"max_steps": 40, "n_threads": 2}
    if parameters.get("cost_mode") == "velocity":
        parameters["speed_limit"] = 1.0
    envs = [safe_mamujoco_v0.parallel_env(**parameters) for _ in range(3)]
    sim = envs[0].batched(3)
    first, _ = sim.reset(np.arange(3), [7, 8, 9])
    for w, env in enumerate(envs):
        observations, _ = env.reset(seed=7 + w)
        np.testing.assert_array_equal(first[w], list(observations.values()))
    rng = np.random.default_rng(0)
    for _ in range(50):
        actions = actions_for(sim, rng, scale=1.3)
        observations, rewards, terminated, truncated, infos = sim.step(actions)
        for w, env in enumerate(envs):
            result = env.step(dict(zip(env.possible_agents, actions[w], strict=True)))
            np.testing.assert_array_equal(observations[w], list(result[0].values()))
            np.testing.assert_array_equal(rewards[w], np.float32(list(result[1].values())))
            assert [terminated[w], truncated[w]] == [result[2]["agent_0"], result[3]["agent_0"]]
            mine = {key: values[w, 1] for key, values in infos.items()}
            assert mine == result[4]["agent_1"]
        ended = np.flatnonzero(terminated | truncated)
        again, _ = sim.reset(ended, [None] * len(ended))
        for row, w in enumerate(ended):
            np.testing.assert_array_equal(again[row], list(envs[w].reset()[0].values()))


@pytest.mark.parametrize("scenario", ROBOTS)
def test_both_backends_of_share_parameters_give_the_same_trajectories(scenario):
    def make():
        return safe_mamujoco_v0.parallel_env(scenario=scenario, max_steps=30)

    batched, single = (share_parameters(make, 3, backend=b) for b in ("batched", "supersuit"))
    assert (batched.team_return, batched.team_cost) == ("shared", "max")
    np.testing.assert_array_equal(batched.reset(), single.reset())
    rng = np.random.default_rng(0)
    for _ in range(70):
        actions = rng.uniform(-1, 1, (6, *batched.action_space.shape)).astype(np.float32)
        mine, theirs = batched.step(actions), single.step(actions)
        for a, b in zip(mine[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(a, b)
        assert data_equivalence(mine[3], theirs[3])


@pytest.mark.parametrize("scenario", ROBOTS)
def test_the_number_of_threads_and_of_worlds_changes_nothing(scenario):
    sims = [
        safe_mamujoco_v0.parallel_env(scenario=scenario, n_threads=n).batched(w)
        for n, w in ((1, 5), (2, 5), (5, 5), (2, 1))
    ]
    for sim in sims:
        sim.reset(np.arange(sim.n_worlds), range(sim.n_worlds))
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = actions_for(sims[0], rng)
        results = [sim.step(actions[: sim.n_worlds]) for sim in sims]
        for other in results[1:]:
            for a, b in zip(results[0][:4], other[:4], strict=True):
                np.testing.assert_array_equal(a[: len(b)], b)


@pytest.mark.parametrize("scenario", ROBOTS)
def test_a_pickled_simulator_continues_identically(scenario):
    sim = safe_mamujoco_v0.parallel_env(scenario=scenario, max_steps=25).batched(3)
    sim.reset(np.arange(3), [1, 2, 3])
    rng = np.random.default_rng(0)
    for _ in range(9):
        sim.step(actions_for(sim, rng))
    copy = pickle.loads(pickle.dumps(sim))
    for _ in range(40):
        actions = actions_for(sim, rng)
        mine, theirs = sim.step(actions), copy.step(actions)
        assert data_equivalence(mine, theirs)
        ended = np.flatnonzero(mine[2] | mine[3])
        again = [s.reset(ended, [None] * len(ended)) for s in (sim, copy)]
        assert data_equivalence(*again)


def test_what_a_step_returns_is_not_changed_by_later_steps():
    sim = safe_mamujoco_v0.parallel_env(scenario="Ant").batched(2)
    sim.reset(np.arange(2), [0, 1])
    rng = np.random.default_rng(0)
    kept = sim.step(actions_for(sim, rng))
    copies = pickle.loads(pickle.dumps(kept))
    sim.step(actions_for(sim, rng))
    sim.reset(np.arange(2), [None, None])
    assert data_equivalence(kept, copies)


@pytest.mark.parametrize(
    ("parameters", "start", "n_pairs"),
    [
        # floor and 13 parts of the Ant
        ({"scenario": "Ant"}, {}, 13),
        ({"scenario": "Ant", "cost_mode": "velocity"}, {}, 13),
        # floor, 13 parts and 6 walls touch each other, but for two parts
        ({"scenario": "Ant", "walls": "free"}, {1: 4.5}, 13 + 6 + 6 * 13 + 15),
        # floor and 8 parts of the HalfCheetah, its bomb and all of these
        ({"scenario": "HalfCheetah"}, {}, 8 + 1 + 8),
        ({"scenario": "HalfCheetah"}, {0: 8.5}, 17),
        ({"scenario": "HalfCheetah", "cost_mode": "velocity"}, {}, 8),
    ],
    ids=str,
)
def test_the_fast_model_moves_exactly_like_the_one_that_is_drawn(parameters, start, n_pairs):
    config = RobotConfig(**parameters)
    models = build_model(config), build_fast_model(config)
    assert (models[0].npair, models[1].npair) == (0, n_pairs)
    datas = [mujoco.MjData(model) for model in models]
    rng, touched = np.random.default_rng(0), set()
    for data in datas:
        for joint, value in start.items():
            data.qpos[joint] += value
    for _ in range(200):
        controls = rng.uniform(-1, 1, models[0].nu)
        for model, data in zip(models, datas, strict=True):
            data.ctrl[:] = controls
            mujoco.mj_step(model, data, nstep=5)
            mujoco.mj_rnePostConstraint(model, data)
        np.testing.assert_array_equal(datas[0].qpos, datas[1].qpos)
        np.testing.assert_array_equal(datas[0].qvel, datas[1].qvel)
        np.testing.assert_array_equal(datas[0].cfrc_ext, datas[1].cfrc_ext)
        touched |= {models[0].geom(geom).name.rstrip("123456") for geom in datas[0].contact.geom2}
    if start:  # right in front of the bomb, or of a wall
        assert touched & {"bomb", "wall"}


def test_contacts_are_listed_only_if_all_have_the_same_parameters():
    model = build_model(RobotConfig("Ant", walls="none"))
    floor = [(0, 1)]
    assert _is_listable(model, floor)
    assert not _is_listable(model, [(1, 2)])  # two parts of the same robot
    model.geom_friction[3, 1] = 0.4
    assert not _is_listable(model, floor)


def slowly(monkeypatch, config, n_worlds):
    """A simulator whose worlds are stepped by Python's threads."""
    with monkeypatch.context() as patch:
        patch.setattr(_mujoco_physics, "Batch", None)
        return safe_mamujoco_v0.SafeMAMuJoCoEnv(config).batched(n_worlds)


@pytest.mark.skipif(_mujoco_physics.Batch is None, reason="needs MuJoCo 4.0")
@pytest.mark.parametrize("cost_mode", ["hazard", "velocity"])
def test_mujocos_threads_and_pythons_give_the_same_numbers(cost_mode, monkeypatch):
    config = RobotConfig("HalfCheetah", cost_mode=cost_mode, max_steps=20)
    sims = safe_mamujoco_v0.SafeMAMuJoCoEnv(config).batched(5), slowly(monkeypatch, config, 5)
    kinds = [type(sim._physics) for sim in sims]
    assert kinds == [_mujoco_physics.BatchPhysics, _mujoco_physics.ThreadedPhysics]
    rng = np.random.default_rng(0)
    assert data_equivalence(*(sim.reset(np.arange(5), range(5)) for sim in sims))
    for _ in range(50):
        actions = actions_for(sims[0], rng)
        mine, theirs = (sim.step(actions) for sim in sims)
        assert data_equivalence(mine, theirs)
        for a, b in zip(sims[0].now, sims[1].now, strict=True):
            np.testing.assert_array_equal(a, b)
        ended = np.flatnonzero(mine[3])
        assert data_equivalence(*(sim.reset(ended, [None] * len(ended)) for sim in sims))
    states = [sim.__getstate__()["mujoco"] for sim in sims]
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("speed", [1e12, 1e9])  # refused at once, or leads to what is refused
@pytest.mark.parametrize("scenario", ROBOTS)
def test_an_unstable_world_starts_anew_in_both_ways_and_leaves_the_others_alone(
    scenario, speed, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo warns in a log file
    env = safe_mamujoco_v0.parallel_env(scenario=scenario)
    speeds = np.zeros((3, env.single_agent_env.model.nv))
    speeds[1, 3] = speed
    sim, calm = env.batched(3), env.batched(2)
    first, _ = sim.reset(np.arange(3), range(3), {"qvel": speeds})
    np.testing.assert_array_equal(first[1], list(env.reset(1, {"qvel": speeds[1]})[0].values()))
    calm.reset(np.arange(2), [0, 2], {"qvel": speeds[[0, 2]]})
    for _ in range(1 if scenario == "Ant" else 4):  # the Ant has fallen then
        actions = actions_for(sim, np.random.default_rng(0))
        observations, rewards, *_ = sim.step(actions)
        expected = env.step(dict(zip(env.possible_agents, actions[1], strict=True)))
        np.testing.assert_array_equal(observations[1], list(expected[0].values()))
        np.testing.assert_array_equal(rewards[1], np.float32(list(expected[1].values())))
        np.testing.assert_array_equal(observations[[0, 2]], calm.step(actions[[0, 2]])[0])
    assert "WARNING" in (tmp_path / "MUJOCO_LOG.TXT").read_text()


def n_threads_at_most(number):
    """Whether threads end; the system still lists a thread for a moment after it was joined."""
    deadline = time.monotonic() + 5
    while len(os.listdir("/proc/self/task")) > number and time.monotonic() < deadline:
        time.sleep(0.01)
    return len(os.listdir("/proc/self/task")) <= number


FORKED = """
import os, signal, sys
import numpy as np
from sb3_e2c.envs import safe_mamujoco_v0
sim = safe_mamujoco_v0.parallel_env(scenario=sys.argv[1], n_threads=2).batched(3)
sim.reset(np.arange(3), range(3))
actions = np.full((3, 2, *sim.action_space("agent_0").shape), 0.5)
sim.step(actions)
child = os.fork()
signal.alarm(30)
moved = sim.step(actions)[0] if sys.argv[2] == "steps" else sim.now.qpos
status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) if child else 0
print(moved.tolist(), flush=True)
sys.exit(status)
"""


@pytest.mark.parametrize("needs_contact", [False, True])
def test_a_fork_while_a_simulator_is_being_made_does_not_touch_it(monkeypatch, needs_contact):
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body/></worldbody></mujoco>")
    real, calls = mujoco.mj_name2id, []

    def forked(*args):
        calls.append(args)
        assert all(hasattr(each, "_pool") or hasattr(each, "_batch") for each in made())
        return real(*args)

    before = set(_mujoco_physics._LIVING)

    def made():
        return set(_mujoco_physics._LIVING) - before

    monkeypatch.setattr(_mujoco_physics.mujoco, "mj_name2id", forked)
    physics = _mujoco_physics.new_physics(model, 1, needs_contact)
    assert calls
    assert made() == {physics}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
@pytest.mark.parametrize("does", ["steps", "only ends"])
@pytest.mark.parametrize("scenario", ROBOTS)
def test_a_forked_process_steps_its_worlds_and_ends(scenario, does):
    command = [sys.executable, "-W", "ignore", "-c", FORKED, scenario, does]
    result = subprocess.run(command, capture_output=True, text=True, timeout=90)
    assert result.returncode == 0, result.stderr
    of_child, of_parent = result.stdout.splitlines()
    assert of_child == of_parent


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted on Linux")
@pytest.mark.parametrize("scenario", ROBOTS)
def test_close_ends_the_threads_and_a_later_step_starts_them_again(scenario):
    gc.collect()  # simulators of other tests
    before = len(os.listdir("/proc/self/task"))
    sims = [
        safe_mamujoco_v0.parallel_env(scenario=scenario, n_threads=3).batched(4) for _ in range(2)
    ]
    rng = np.random.default_rng(0)
    for sim in sims:
        sim.reset(np.arange(4), range(4))
    for _ in range(3):
        actions = actions_for(sims[0], rng)
        assert data_equivalence(*(sim.step(actions) for sim in sims))
        sims[0].close()
        assert n_threads_at_most(before + 2)  # those of the second
    sims[1].close()
    assert n_threads_at_most(before)
    pickle.dumps(sims)  # needs no threads
    assert n_threads_at_most(before)


def test_a_time_limit_truncates():
    env = safe_mamujoco_v0.parallel_env(max_steps=2)
    env.reset(seed=0)
    assert not any(env.step(rest(env))[3].values())
    _, _, terminated, truncated, _ = env.step(rest(env))
    assert all(truncated.values())
    assert not any(terminated.values())
    assert env.agents == []


# ---- mistakes


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"scenario": "Humanoid"}, "scenario is 'Humanoid'; expected one of"),
        ({"scenario": "Ant", "agent_conf": "2x3"}, "agent_conf is '2x3'; expected one of"),
        ({"obs_mode": "local"}, "obs_mode is 'local'"),
        ({"agent_obsk": -1}, "agent_obsk is -1; expected an integer of at least 0"),
        ({"max_steps": 0}, "max_steps is 0; expected an integer of at least 1"),
        ({"walls": "free"}, "walls is 'free' with HalfCheetah"),
        ({"walls": "solid"}, "walls is 'solid'; expected one of"),
        ({"strict_outside": 1}, "strict_outside is 1; expected True or False"),
        ({"per_vector_norm": True, "obs_mode": "obsk"}, "expected 'full'"),
        ({"cost_mode": "speed"}, "cost_mode is 'speed'"),
        ({"speed_limit": 2.0}, "use cost_mode='velocity'"),
        ({"cost_mode": "velocity", "agent_conf": "3x2"}, "give speed_limit in m/s"),
        ({"cost_mode": "velocity", "speed_limit": -1.0}, "speed_limit is -1.0"),
        ({"n_threads": 0}, "n_threads is 0"),
        ({"render_mode": "human"}, "render_mode is 'human'"),
    ],
)
def test_a_bad_parameter_is_named_with_what_was_expected(parameters, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        safe_mamujoco_v0.parallel_env(**parameters)


def test_a_misspelled_parameter_gets_a_suggestion():
    with pytest.raises(TypeError, match="did you mean 'max_steps'"):
        safe_mamujoco_v0.parallel_env(max_step=5)


def test_wrong_calls_are_refused_with_the_place_of_the_mistake():
    env = safe_mamujoco_v0.parallel_env()
    with pytest.raises(ValueError, match="no episode is running"):
        env.step(rest(env))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"no action for \['agent_1'\]"):
        env.step({"agent_0": np.zeros(3)})
    with pytest.raises(ValueError, match=r"agent_1 is \[nan, 0.0, 0.0\]"):
        env.step(rest(env) | {"agent_1": np.array([np.nan, 0, 0])})
    with pytest.raises(ValueError, match=r"shape \(3,\); expected \(10,\)"):
        env.reset(options={"qpos": [1, 2, 3]})
    with pytest.raises(ValueError, match="needs a render mode"):
        env.render()


def test_wrong_calls_of_the_simulator_are_refused_too():
    sim = safe_mamujoco_v0.parallel_env().batched(2)
    with pytest.raises(ValueError, match=r"world\(s\) \[0, 1\] has ended or not begun"):
        sim.step(np.zeros((2, 2, 3)))
    sim.reset(np.arange(2), [0, 1])
    with pytest.raises(ValueError, match=r"expected \(W, N, A\) = \(2, 2, 3\)"):
        sim.step(np.zeros((2, 6)))
    with pytest.raises(ValueError, match=r"agent_1 in world 0 is \[0.0, inf, 0.0\]"):
        sim.step(np.array([[[0, 0, 0], [0, np.inf, 0]], [[0, 0, 0], [0, 0, 0]]]))
    with pytest.raises(ValueError, match="needs a render mode"):
        sim.render(0)
    with pytest.raises(ValueError, match="n_worlds is 0"):
        safe_mamujoco_v0.parallel_env().batched(0)


# ---- pictures


def redness(picture):
    """How many pixels are red and neither pale nor brown."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return int(((red > 80) & (green < 30) & (blue < 30)).sum())


def picture_or_skip(env, *args):
    try:
        return env.render(*args)
    except OSError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(
    ("scenario", "joint", "free", "costing"), [("Ant", 1, 0.0, 4.0), ("HalfCheetah", 0, -3.0, 4.0)]
)
def test_what_costs_is_red_in_the_picture_and_the_camera_follows(scenario, joint, free, costing):
    env = at(scenario, {}, render_mode="rgb_array")
    for value, is_costing in ((free, False), (costing, True)):
        qpos = env.single_agent_env.model.qpos0.copy()
        qpos[joint] = value
        env.reset(seed=0, options={"qpos": qpos})
        env.step(rest(env))
        picture = picture_or_skip(env)
        assert picture.shape == (480, 640, 3)
        assert picture.dtype == np.uint8
        assert (redness(picture) > 50) == is_costing
    env.close()


def test_a_batched_world_looks_like_the_single_world():
    env = at("Ant", {1: 4.0}, render_mode="rgb_array")
    sim = env.batched(2)
    model = env.single_agent_env.model
    beside_the_wall = {"qpos": env.single_agent_env.data.qpos.copy(), "qvel": np.zeros(model.nv)}
    sim.reset(np.array([0]), [0])
    sim.reset(np.array([1]), [0], beside_the_wall)
    env.step(rest(env))
    sim.step(np.zeros((2, 2, 4)))
    picture = picture_or_skip(sim, 1)
    np.testing.assert_array_equal(picture, env.render())
    assert redness(picture) > 50
    assert redness(sim.render(0)) == 0
    env.close()
    pickle.loads(pickle.dumps(sim)).close()  # OpenGL stays out of pickles
    sim.close()


@pytest.mark.parametrize("backend", ["nothing", "glfw"])
def test_without_opengl_one_line_says_what_to_install(monkeypatch, backend):
    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = safe_mamujoco_v0.parallel_env(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(OSError, match=r"^rendering needs OpenGL, .* MUJOCO_GL=egl.*$") as caught:
        env.render()
    assert "\n" not in str(caught.value)


def test_a_mujoco_that_cannot_be_imported_says_so_in_one_line():
    result = subprocess.run(
        [sys.executable, "-c", "from sb3_e2c.envs import safe_mamujoco_v0"],
        env=os.environ | {"MUJOCO_GL": "nothing"},
        capture_output=True,
        text=True,
        check=False,
    )
    last = result.stderr.strip().splitlines()[-1]
    assert re.fullmatch(r"OSError: MuJoCo cannot .*MUJOCO_GL='nothing'.*unset MUJOCO_GL.*", last)


def test_pictures_of_several_environments_do_not_mix():
    first, second = (
        safe_mamujoco_v0.parallel_env(scenario=robot, render_mode="rgb_array") for robot in ROBOTS
    )
    for env in (first, second):
        env.reset(seed=0)
    alone = first.render()
    second.render()
    np.testing.assert_array_equal(first.render(), alone)
    second.close()
    np.testing.assert_array_equal(first.render(), alone)
    first.close()
