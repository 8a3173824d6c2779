"""The environments: every registered id conforms; then the rules of the rover domain by hand."""

import builtins
import pickle
import re
import warnings

import gymnasium
import numpy as np
import pettingzoo
import pytest

from sb3_e2c.envs import ENV_IDS, multi_rover_v0
from sb3_e2c.envs._rover_config import RoverConfig

with warnings.catch_warnings():  # PettingZoo's own tests import a module that it deprecates
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

ROVER_IDS = [env_id for env_id in ENV_IDS if env_id.startswith("MultiRover")]
FAR_POIS = [(1, 1), (1, 19), (19, 1), (19, 19)]
FAR_ROVERS = [(6, 6), (6, 10), (6, 14), (10, 6), (10, 14), (14, 10)]
INPUTS = {"add_id": True, "add_velocity": True, "add_position": True, "add_critic_state": True}


def sample(env):
    return {agent: env.action_space(agent).sample() for agent in env.agents}


def placed(rovers, pois=FAR_POIS, **parameters):
    """One world with hand-placed rovers and POIs."""
    parameters.setdefault("poi_values", (5.0,) * len(pois))
    sim = multi_rover_v0.parallel_env(n_rovers=len(rovers), **parameters).batched(1)
    sim.reset(np.array([0]), [0], {"rovers": rovers, "pois": pois})
    return sim


def stay(sim):
    """One step without motion: observations, reward, terminated, truncated, infos of world 0."""
    observations, rewards, terminated, truncated, infos = sim.step(
        np.zeros((sim.n_worlds, sim.config.n_rovers, 2))
    )
    world = {key: value[0] for key, value in infos.items()}
    return observations[0], rewards[0, 0], terminated[0], truncated[0], world


# ---- every registered environment


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_the_parallel_api_test_passes(env_id):
    parallel_api_test(ENV_IDS[env_id](), num_cycles=200)


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_the_same_seed_gives_the_same_episode(env_id):
    parallel_seed_test(ENV_IDS[env_id], num_cycles=100)


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_pettingzoo_makes_it_by_id_without_wrappers(env_id):
    env = pettingzoo.make("parallel", env_id)
    assert type(env) is type(ENV_IDS[env_id]())


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_observations_lie_in_their_space_and_costs_are_reported(env_id):
    env = ENV_IDS[env_id]()
    observations, _ = env.reset(seed=3)
    for _ in range(20):
        for agent in env.agents:
            assert env.observation_space(agent).contains(observations[agent])
        observations, rewards, _, _, infos = env.step(sample(env))
        assert all(isinstance(reward, float) for reward in rewards.values())
        assert all("cost" in info for info in infos.values())


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_a_pickle_taken_during_an_episode_continues_identically(env_id):
    env = ENV_IDS[env_id]()
    env.reset(seed=5)
    for _ in range(7):
        env.step(sample(env))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(200):
        actions = sample(env)
        results = env.step(actions), copy.step(actions)
        assert gymnasium.utils.env_checker.data_equivalence(*results)
        if not env.agents:
            assert gymnasium.utils.env_checker.data_equivalence(env.reset(), copy.reset())


def test_a_factory_of_a_registered_id_pickles():
    factory = pickle.loads(pickle.dumps(ENV_IDS["MultiRover-8-3-v0"]))
    assert factory(max_cycles=7).config.max_cycles == 7


# ---- multi-rover: spaces, metadata, parameters


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_an_id_names_rovers_and_coupling(env_id):
    rovers, coupling = map(int, env_id.split("-")[1:3])
    env = ENV_IDS[env_id]()
    assert (len(env.possible_agents), env.config.coupling) == (rovers, coupling)
    assert env.observation_space("rover_0").shape == (8,)
    assert env.action_space("rover_0").shape == (2,)


@pytest.mark.parametrize("env_id", ROVER_IDS)
def test_documented_infos_are_the_real_infos(env_id):
    env = ENV_IDS[env_id](**INPUTS)
    _, infos = env.reset(seed=0)
    assert set(infos["rover_0"]) == {"captured", "position", "novelty_observation", "critic_state"}
    for _ in range(30):
        observations, _, _, _, infos = env.step(sample(env))
        for agent, info in infos.items():
            assert set(info) == {
                *("cost", "beta", "captured", "colliding_pairs"),
                *("position", "novelty_observation", "critic_state"),
            }
            assert info["cost"] in (0.0, 1.0)
            assert isinstance(info["cost"], float)
            assert isinstance(info["captured"], int)
            assert info["position"].shape == info["critic_state"].shape == (2,)
            np.testing.assert_array_equal(info["novelty_observation"], observations[agent][:8])


def test_the_metadata_declare_a_shared_return_and_a_summed_cost():
    metadata = multi_rover_v0.parallel_env().metadata
    assert metadata["name"] == "multi_rover_v0"
    assert (metadata["team_return"], metadata["team_cost"]) == ("shared", "sum")


def test_every_parameter_is_documented():
    documented = re.findall(r"``(\w+)``", multi_rover_v0.MultiRoverEnv.__doc__)
    assert set(RoverConfig.__dataclass_fields__) <= set(documented)


@pytest.mark.parametrize("preset", multi_rover_v0.PRESETS)
def test_a_preset_runs_a_whole_episode(preset):
    env = multi_rover_v0.parallel_env(preset)
    observations, _ = env.reset(seed=1)
    steps = 0
    while env.agents:
        observations, *_ = env.step(sample(env))
        steps += 1
    assert env.observation_space("rover_0").contains(observations["rover_0"])
    assert steps == {"e2c": 80, "nsmerl_6_4": 50, "nsmerl_circular": 40, "merl": 50}[preset]


def test_the_rings_of_ns_merl_have_three_pois_each_120_degrees_apart():
    sim = multi_rover_v0.parallel_env("nsmerl_circular").batched(1)
    sim.reset(np.array([0]), [4])
    radii = np.hypot(*(sim.state.pois[0] - 10).T)
    np.testing.assert_allclose(radii, [5, 5, 5, 10, 10, 10])
    sides = np.hypot(
        *(sim.state.pois[0] - np.roll(sim.state.pois[0].reshape(2, 3, 2), 1, 1).reshape(6, 2)).T
    )
    np.testing.assert_allclose(sides, np.sqrt(3) * radii)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"coupling": 7}, "coupling is 7 with 6 rovers"),
        ({"n_rovers": 50}, "has 49 cells"),
        ({"n_rovers": 6.0}, "n_rovers is 6.0; expected an integer"),
        ({"dim": -1.0}, "dim is -1.0; expected a finite number above 0"),
        ({"max_step": float("nan")}, "max_step is nan"),
        ({"poi_values": ()}, "poi_values is ()"),
        ({"poi_values": (5.0,) * 200}, "found room for"),
        ({"poi_placement": "rings", "poi_values": (5.0,) * 5}, "give an even number"),
        ({"sensor_type": "nearest"}, "sensor_type is 'nearest'; expected one of"),
        ({"sensor_scale": "log", "sensor_radius": 0.5}, "needs a sensor_radius above 0.5"),
        ({"preset": "ec2"}, "preset is 'ec2'; expected one of"),
        ({"render_mode": "human"}, "render_mode is 'human'"),
    ],
)
def test_a_bad_parameter_is_named_with_what_was_expected(parameters, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        multi_rover_v0.parallel_env(**parameters)


def test_a_misspelled_parameter_gets_a_suggestion():
    with pytest.raises(TypeError, match="did you mean 'n_rovers'"):
        multi_rover_v0.parallel_env(n_rover=6)
    with pytest.raises(TypeError, match="early_stop is 1; expected True or False"):
        multi_rover_v0.parallel_env(early_stop=1)


def test_wrong_calls_are_refused_with_the_place_of_the_mistake():
    env = multi_rover_v0.parallel_env(max_cycles=1)
    with pytest.raises(ValueError, match="has ended or not begun"):
        env.step(dict.fromkeys(env.possible_agents, np.zeros(2)))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"no action for \['rover_0'\]"):
        env.step({agent: np.zeros(2) for agent in env.agents[1:]})
    bad = dict.fromkeys(env.agents, np.zeros(2)) | {"rover_3": np.array([0.0, np.inf])}
    with pytest.raises(ValueError, match=r"rover_3 in world 0 is \[0.0, inf\]"):
        env.step(bad)
    with pytest.raises(ValueError, match=r"has shape \(1, 2\); expected \(6, 2\)"):
        env.reset(options={"rovers": [(1, 1)]})
    with pytest.raises(ValueError, match="outside the world"):
        env.reset(options={"pois": [(1, 1), (1, 2), (1, 3), (1, 21)]})


# ---- multi-rover: starts and motion


def test_rovers_start_on_different_central_cells_and_pois_lie_outside():
    sim = multi_rover_v0.parallel_env(n_rovers=10, coupling=4).batched(200)
    sim.reset(np.arange(200), range(200))
    rovers, pois = sim.state.positions, sim.state.pois
    assert (np.abs(rovers - 10) <= 3).all()
    assert (rovers == rovers.round()).all()
    assert all(len(np.unique(world, axis=0)) == 10 for world in rovers)
    assert (np.abs(pois - 10).max(axis=-1) > 5).all()
    assert ((pois >= 0) & (pois <= 20)).all()
    distances = np.hypot(*np.moveaxis(pois[:, :, None] - pois[:, None], -1, 0))
    assert (distances + 4 * np.eye(4)).min() >= 4


def test_actions_are_clipped_scaled_and_positions_clamped():
    sim = placed([(10, 10), (19.8, 0.1)], coupling=1, max_step=0.5, add_velocity=True)
    observations, _, _, _, infos = sim.step(np.array([[[3.0, -0.5], [1.0, -1.0]]]))
    np.testing.assert_allclose(infos["position"][0], [(10.5, 9.75), (20.0, 0.0)])
    np.testing.assert_allclose(observations[0, :, 8:], [(0.5, -0.25), (0.2, -0.1)], rtol=1e-6)


# ---- multi-rover: costs


def test_a_collision_is_strictly_closer_than_half_a_unit():
    _, _, _, _, at_half = stay(placed([(10, 10), (10.5, 10), (6, 6)]))
    np.testing.assert_array_equal(at_half["cost"], [0, 0, 0])
    _, _, _, _, closer = stay(placed([(10, 10), (10.49, 10), (6, 6)]))
    np.testing.assert_array_equal(closer["cost"], [1, 1, 0])
    np.testing.assert_array_equal(closer["colliding_pairs"], [1, 1, 1])


def test_a_rover_in_two_collisions_costs_one():
    # 0-1 and 1-2 are 0.4 apart, 0-2 are 0.8 apart: two pairs, three colliding rovers
    _, _, _, _, infos = stay(placed([(10, 10), (10.4, 10), (10.8, 10)]))
    np.testing.assert_array_equal(infos["cost"], [1, 1, 1])
    assert infos["colliding_pairs"][0] == 2


def test_the_collision_is_tested_after_the_move():
    sim = placed([(10, 10), (11, 10)])
    _, _, _, _, infos = sim.step(np.array([[[0.5, 0.0], [0.0, 0.0]]]))
    assert infos["cost"].sum() == 0  # now exactly 0.5 apart
    _, _, _, _, infos = sim.step(np.array([[[0.25, 0.0], [0.0, 0.0]]]))
    assert infos["cost"].sum() == 2


# ---- multi-rover: captures, relevance, rewards


@pytest.mark.parametrize(("n_close", "captured"), [(2, 0), (3, 1), (4, 1)])
def test_a_poi_needs_as_many_rovers_as_the_coupling_says(n_close, captured):
    close = [(1, 1 + 0.5 * i) for i in range(n_close)]
    sim = placed(close + FAR_ROVERS[n_close:], coupling=3)
    assert stay(sim)[-1]["captured"][0] == captured


def test_the_activation_radius_is_inclusive():
    assert stay(placed([(1, 3)], coupling=1))[-1]["captured"][0] == 1
    assert stay(placed([(1, 3.01)], coupling=1))[-1]["captured"][0] == 0


def test_visitors_must_come_at_the_same_step():
    # rover 0 visits (1, 1) at the first step only, rover 1 from the second step on
    sim = placed([(1, 3), (4, 1)], coupling=2)
    assert stay(sim)[-1]["captured"][0] == 0
    _, _, _, _, infos = sim.step(np.array([[[0.0, 1.0], [-1.0, 0.0]]]))
    assert infos["captured"][0, 0] == 0
    _, _, _, _, infos = sim.step(np.array([[[0.0, -1.0], [0.0, 0.0]]]))
    assert infos["captured"][0, 0] == 1


def test_a_poi_is_captured_once():
    sim = placed([(1, 1), (10, 10)], coupling=1, reward_at="capture")
    assert stay(sim)[1] == 0.25
    _, reward, _, _, infos = stay(sim)
    assert reward == 0.0
    assert infos["captured"][0] == 1
    assert infos["beta"][0] == 1.0


def test_beta_is_the_product_of_the_values_of_open_pois_in_reach():
    pois, values = [(5, 5), (6, 5), (15, 15)], (2.0, 3.0, 7.0)
    # rover 0 reaches both; rover 1, at distances 2.5 and 1.5, the second; rover 2 none
    sim = placed([(5.5, 5), (7.5, 5), (10, 15)], pois, poi_values=values, coupling=2)
    np.testing.assert_array_equal(stay(sim)[-1]["beta"], [6.0, 3.0, 1.0])
    # the second POI was captured in that step: its visitors still had its value, and lose it now
    np.testing.assert_array_equal(stay(sim)[-1]["beta"], [2.0, 1.0, 1.0])


def test_the_end_reward_is_the_captured_share_of_the_value_paid_at_the_last_step():
    pois, values = [(1, 1), (19, 19)], (2.0, 6.0)
    sim = placed([(1, 1), (10, 10)], pois, poi_values=values, coupling=1, max_cycles=3)
    assert [stay(sim)[1] for _ in range(3)] == [0.0, 0.0, 0.25]


def test_the_capture_reward_has_the_same_total_paid_when_earned():
    pois, values = [(1, 1), (19, 19)], (2.0, 6.0)
    here = {"poi_values": values, "coupling": 1, "reward_at": "capture", "max_cycles": 3}
    sim = placed([(1, 1), (19, 15.5)], pois, **here)
    # rover 1 climbs towards the second POI: distances 2.5 and 1.5
    rewards = [sim.step(np.array([[[0, 0], [0, 1.0]]]))[1][0].tolist() for _ in range(3)]
    assert rewards == [[0.25] * 2, [0.75] * 2, [0.0] * 2]


@pytest.mark.parametrize("reward_at", ["end", "capture"])
def test_a_capture_at_the_last_step_counts(reward_at):
    sim = placed([(1, 3.5), (10, 10)], coupling=1, max_cycles=1, reward_at=reward_at)
    _, rewards, _, truncated, infos = sim.step(np.array([[[0.0, -1.0], [0.0, 0.0]]]))
    np.testing.assert_array_equal(rewards[0], [0.25, 0.25])
    assert infos["captured"][0, 0] == 1
    assert truncated[0]


@pytest.mark.parametrize(
    ("time_limit", "ended"), [("truncate", (False, True)), ("terminate", (True, False))]
)
def test_the_time_limit_truncates_or_terminates(time_limit, ended):
    sim = placed(FAR_ROVERS, max_cycles=2, time_limit=time_limit)
    assert stay(sim)[2:4] == (False, False)
    assert stay(sim)[2:4] == ended


def test_early_stop_ends_and_pays_when_all_pois_are_captured():
    here = {"pois": [(1, 1), (19, 19)], "coupling": 1}
    _, reward, terminated, truncated, _ = stay(placed([(1, 1), (19, 19)], early_stop=True, **here))
    assert (reward, terminated, truncated) == (1.0, True, False)
    _, reward, terminated, truncated, _ = stay(placed([(1, 1), (19, 19)], **here))
    assert (reward, terminated, truncated) == (0.0, False, False)
    at_limit = placed([(1, 1), (19, 19)], early_stop=True, max_cycles=1, **here)
    assert stay(at_limit)[1:4] == (1.0, True, False)


def test_the_critic_state_is_captured_share_and_time():
    sim = placed([(1, 1), (10, 10)], coupling=1, max_cycles=8, add_critic_state=True)
    _, infos = sim.reset(np.array([0]), [0], {"rovers": [(1, 1), (10, 10)], "pois": FAR_POIS})
    np.testing.assert_array_equal(infos["critic_state"], np.zeros((1, 2, 2)))
    np.testing.assert_array_equal(stay(sim)[-1]["critic_state"], [(0.25, 0.125)] * 2)
    assert stay(sim)[-1]["critic_state"].dtype == np.float32


# ---- multi-rover: sensors


@pytest.mark.parametrize(
    ("offset", "sector"),
    [
        *(((1, 2), 0), ((2, -1), 1), ((-1, -2), 2), ((-2, 1), 3)),
        *(((0, 2), 0), ((2, 0), 1), ((0, -2), 2), ((-2, 0), 3), ((0, 0), 0)),
    ],
)
@pytest.mark.parametrize("n_sectors", [4, 8])
def test_a_target_is_sensed_in_the_sector_of_its_direction(offset, sector, n_sectors):
    squared = max(offset[0] ** 2 + offset[1] ** 2, 0.25)
    target = (10 + offset[0], 10 + offset[1])
    wide = sector * n_sectors // 4  # all offsets lie in the first half of their quarter
    sensors = stay(placed([(10, 10), (0, 20)], [target], n_sectors=n_sectors))[0][0]
    expected = np.full(2 * n_sectors, -1.0)
    expected[n_sectors + wide] = 5.0 / squared
    np.testing.assert_allclose(sensors, expected, rtol=1e-6)
    sensors = stay(placed([(10, 10), target], [(0, 20)], n_sectors=n_sectors))[0][0]
    expected = np.full(2 * n_sectors, -1.0)
    expected[wide] = 1.0 / squared
    np.testing.assert_allclose(sensors, expected, rtol=1e-6)


def test_the_sensor_radius_is_inclusive_and_an_empty_sector_is_minus_one():
    assert stay(placed([(0, 0), (6, 8)], [(20, 20)]))[0][0, 0] == np.float32(0.01)
    assert (stay(placed([(0, 0), (6, 8.01)], [(20, 20)]))[0][0] == -1).all()


@pytest.mark.parametrize(
    ("sensor_type", "rover", "poi"),
    [("closest", 1, 5), ("density", 0.625, 3.125), ("sum", 1.25, 6.25)],
)
def test_sensor_types_take_the_largest_the_mean_or_the_sum(sensor_type, rover, poi):
    # two rovers and two POIs of value 5 at distances 1 and 2 in sector 0, borders included
    rovers, pois = [(10, 10), (10, 11), (10, 12)], [(10, 11), (10, 12)]
    observations = stay(placed(rovers, pois, coupling=3, act_radius=0.1, sensor_type=sensor_type))[
        0
    ]
    np.testing.assert_allclose(observations[0], [rover, -1, -1, -1, poi, -1, -1, -1])


def test_a_captured_poi_vanishes_from_the_observation_of_the_same_step():
    sim = placed([(1, 2), (10, 10)], [(1, 1), (1, 8)], coupling=1)
    observation = stay(sim)[0][0]
    np.testing.assert_allclose(observation[4:], [5 / 36, -1, -1, -1])


def test_the_log_scale_maps_the_reach_to_zero_and_the_near_limit_to_one():
    # R² = 100: POIs of value 8 (largest) at distances 0.5 and 10; one of value 2 at distance 2
    pois, values = [(10, 10.5), (20, 10), (10, 8)], (8.0, 8.0, 2.0)
    sim = placed([(10, 10), (7, 6)], pois, poi_values=values, sensor_scale="log", coupling=2)
    observations, _, _, _, infos = stay(sim)
    middle = np.log(0.5 * 100 / 8) / np.log(400)
    np.testing.assert_allclose(observations[0, 4:], [1.0, 0.0, middle, -1.0], atol=1e-6)
    np.testing.assert_allclose(infos["novelty_observation"][0, 4:], [32, 0.08, 0.5, -1], rtol=1e-6)
    # the other rover is 5 away in sector 2; its V_max is 1
    rover = np.log(100 / 25) / np.log(400)
    np.testing.assert_allclose(observations[0, :4], [-1, -1, rover, -1], atol=1e-6)


def test_identity_velocity_and_position_follow_the_sensors():
    sim = placed([(10, 10), (4, 2)], coupling=2, add_id=True, add_velocity=True, add_position=True)
    observations, *_ = sim.step(np.array([[[1.0, -1.0], [0.0, 0.5]]]))
    np.testing.assert_allclose(observations[0, 0, 8:], [1, 0, 1, -1, 0.55, 0.45], rtol=1e-6)
    np.testing.assert_allclose(observations[0, 1, 8:], [0, 1, 0, 0.5, 0.2, 0.125], rtol=1e-6)


# ---- multi-rover: batches


@pytest.mark.parametrize("parameters", [{}, {"preset": "merl", "sensor_type": "density"}, INPUTS])
def test_a_world_of_a_batch_equals_the_single_environment_with_its_seed(parameters):
    make_env = lambda: multi_rover_v0.parallel_env(**(parameters | {"max_cycles": 30}))  # noqa: E731
    sim, singles = make_env().batched(3), [make_env() for _ in range(3)]
    observations, _ = sim.reset(np.arange(3), [7, 8, 9])
    rng = np.random.default_rng(0)
    for w, env in enumerate(singles):
        single, _ = env.reset(seed=7 + w)
        np.testing.assert_array_equal(np.stack(list(single.values())), observations[w])
    for _ in range(75):  # two ends of an episode inside
        actions = rng.uniform(-1.5, 1.5, (3, 6, 2))
        observations, rewards, terminated, truncated, infos = sim.step(actions)
        for w, env in enumerate(singles):
            single = env.step(dict(zip(env.agents, actions[w], strict=True)))
            np.testing.assert_array_equal(np.stack(list(single[0].values())), observations[w])
            assert list(single[1].values()) == rewards[w].tolist()
            assert single[2]["rover_0"] == terminated[w]
            assert single[3]["rover_0"] == truncated[w]
            for i, info in enumerate(single[4].values()):
                assert all(np.array_equal(info[key], infos[key][w, i]) for key in infos)
        done = np.flatnonzero(terminated | truncated)
        assert len(done) in (0, 3)
        if len(done):
            observations, _ = sim.reset(done, [None] * len(done))
            for w, env in enumerate(singles):
                single, _ = env.reset()
                np.testing.assert_array_equal(np.stack(list(single.values())), observations[w])


def test_resetting_one_world_leaves_the_others_alone():
    sim = multi_rover_v0.parallel_env().batched(2)
    sim.reset(np.arange(2), [0, 1])
    before = sim.state.positions.copy()
    sim.reset(np.array([1]), [None])
    np.testing.assert_array_equal(sim.state.positions[0], before[0])
    assert (sim.state.positions[1] != before[1]).any()


def test_a_new_episode_forgets_the_last_one():
    sim = placed([(1, 1), (1.1, 1)], coupling=1, add_velocity=True, add_critic_state=True)
    sim.step(np.ones((1, 2, 2)))
    observations, infos = sim.reset(np.array([0]), [None])
    assert (observations[..., 8:] == 0).all()
    assert (infos["captured"] == 0).all()
    assert (infos["critic_state"] == 0).all()
    assert sim.state.team_cost[0] == 0


def test_returned_arrays_belong_to_the_caller():
    sim = placed(FAR_ROVERS)
    first = sim.step(np.zeros((1, 6, 2)))
    kept = [np.array(first[0]), np.array(first[-1]["position"])]
    sim.step(np.ones((1, 6, 2)))
    np.testing.assert_array_equal(first[0], kept[0])
    np.testing.assert_array_equal(first[-1]["position"], kept[1])


# ---- multi-rover: pictures


def test_a_collision_turns_the_frame_of_the_picture_red():
    pytest.importorskip("PIL")
    env = multi_rover_v0.parallel_env(n_rovers=2, render_mode="rgb_array")
    frames = []
    for rovers in ([(10, 10), (10.6, 10)], [(10, 10), (10.4, 10)]):
        env.reset(seed=0, options={"rovers": rovers})
        env.step(dict.fromkeys(env.agents, np.zeros(2)))
        frames.append(env.render())
    assert frames[0].shape == (656, 608, 3)
    assert frames[0].dtype == np.uint8
    left_edge = [tuple(frame[350, 14].tolist()) for frame in frames]
    assert left_edge == [(255, 255, 255), (235, 20, 20)]


def test_rendering_without_pillow_names_the_extra(monkeypatch):
    env = multi_rover_v0.parallel_env(render_mode="rgb_array")
    env.reset(seed=0)
    real_import = builtins.__import__

    def without_pillow(name, *args, **kwargs):
        if name.split(".")[0] == "PIL":
            raise ImportError("No module named 'PIL'")
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_pillow)
    with pytest.raises(ImportError, match=re.escape("pip install sb3-e2c[envs]")):
        env.render()


def test_rendering_without_a_render_mode_says_what_to_do():
    env = multi_rover_v0.parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="render_mode='rgb_array'"):
        env.render()


# ---- multi-rover: calibration of costs against scripted teams


def play(rovers, coupling, controller, n_episodes=400):
    """Team return and team cost of each episode, both of shape (n_episodes,)."""
    sim = multi_rover_v0.parallel_env(n_rovers=rovers, coupling=coupling).batched(n_episodes)
    sim.reset(np.arange(n_episodes), range(n_episodes))
    rng = np.random.default_rng(0)
    returns, costs = np.zeros(n_episodes), np.zeros(n_episodes)
    for _ in range(80):
        _, rewards, _, _, infos = sim.step(controller(sim, rng))
        returns += rewards[:, 0]
        costs += infos["cost"].sum(axis=1)
    return returns, costs


def wander(sim, rng):
    return rng.uniform(-1, 1, (sim.n_worlds, sim.config.n_rovers, 2))


def careless(sim, rng, slot_radius=0.0):
    """Groups of at least c rovers head for the nearest open POI that no group before them chose."""
    rovers, pois, is_open = sim.state.positions, sim.state.pois, ~sim.state.captured
    group = np.arange(sim.config.n_rovers) % (sim.config.n_rovers // sim.config.coupling)
    targets, unchosen = np.zeros_like(rovers), is_open.copy()
    for members in (np.flatnonzero(group == g) for g in range(group.max() + 1)):
        allowed = np.where(unchosen.any(axis=1, keepdims=True), unchosen, is_open)
        distance = np.linalg.norm(pois - rovers[:, members].mean(axis=1)[:, None], axis=-1)
        choice = np.where(allowed, distance, np.inf).argmin(axis=1)
        unchosen[np.arange(len(pois)), choice] = False
        angles = 2 * np.pi * np.arange(len(members)) / len(members)
        slots = slot_radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        targets[:, members] = pois[np.arange(len(pois)), choice][:, None] + slots
    move = targets - rovers
    move /= np.maximum(np.linalg.norm(move, axis=-1, keepdims=True), 1.0)
    move[~is_open.any(axis=1)] = 0.0
    return move + rng.normal(0.0, 0.3, rovers.shape)


def avoid(sim, rng):
    """The same with slots around the POI and a push away from rovers closer than 1.6."""
    rovers = sim.state.positions
    apart = rovers[:, :, None] - rovers[:, None]
    distance = np.maximum(np.linalg.norm(apart, axis=-1, keepdims=True), 1e-9)
    push = (apart / distance * np.maximum(1.6 - distance, 0.0)).sum(axis=2)
    return careless(sim, rng, slot_radius=1.4) + push


@pytest.mark.parametrize(("rovers", "cost", "std"), [(6, 10, 7), (8, 19, 10), (10, 32, 13)])
def test_a_random_team_costs_what_was_calibrated_and_earns_nothing(rovers, cost, std):
    returns, costs = play(rovers, 3, wander)
    assert abs(costs.mean() - cost) < 4 * std * np.sqrt(1 / 400 + 1 / 100)  # 100 when calibrated
    assert abs(costs.std() - std) < 0.2 * std
    assert returns.mean() < 0.1


@pytest.mark.parametrize(
    ("rovers", "coupling", "limit", "cost"),
    [
        *((6, 2, 2, 23.3), (6, 3, 20, 53.4), (6, 4, 20, 132.8)),
        *((8, 3, 40, 85.4), (8, 4, 30, 106.2), (10, 4, 75, 143.2)),
    ],
)
def test_every_limit_binds_a_careless_team_and_leaves_room_for_a_careful_one(
    rovers, coupling, limit, cost
):
    returns, costs = play(rovers, coupling, careless)
    assert returns.mean() == 1.0
    assert costs.mean() > 1.5 * limit
    assert abs(costs.mean() - cost) < 3 * costs.std() * np.sqrt(1 / 400 + 1 / 100)
    returns, costs = play(rovers, coupling, avoid)
    assert returns.mean() > 0.99
    assert costs.mean() < 0.5 * limit
