"""The particle tasks: mpe2's worlds, the simulator that must equal them, costs by hand."""

import builtins
import pickle
import re
import subprocess
import sys
import warnings
from functools import partial
from importlib import import_module

import gymnasium
import numpy as np
import pettingzoo
import pytest

from sb3_e2c.envs import ENV_IDS, keep_away_v0, physical_deception_v0, predator_prey_v0
from sb3_e2c.envs._particle_config import KEEP_AWAY, PHYSICAL_DECEPTION, PREDATOR_PREY, TASKS

with warnings.catch_warnings():  # PettingZoo's own tests import a module that it deprecates
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test, parallel_seed_test

MODULES = [physical_deception_v0, keep_away_v0, predator_prey_v0]
NAMES = [task.name for task in TASKS]
FAR = [(-3, 0), (3, 0), (0, 3), (0, -3), (5, 5), (6, -6), (-7, 7)]

each_id = pytest.mark.parametrize(
    "env_id", ["PhysicalDeception-v0", "KeepAway-v0", "PredatorPrey-v0"]
)
each_module = pytest.mark.parametrize("module", MODULES, ids=NAMES)
each_kind = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])


def sample(env):
    return {agent: env.action_space(agent).sample() for agent in env.agents}


def random_actions(rng, sim):
    """Actions of all worlds by group; the continuous ones also leave their space."""
    if sim.config.continuous_actions:
        return {g: rng.uniform(-0.3, 1.3, (sim.n_worlds, len(n), 5)) for g, n in sim.groups.items()}
    return {g: rng.integers(5, size=(sim.n_worlds, len(n))) for g, n in sim.groups.items()}


def by_agent(sim, grouped, world=0):
    """Rows of one world as a dict, in world order."""
    rows = {a: grouped[g][world, i] for g, names in sim.groups.items() for i, a in enumerate(names)}
    return {agent: rows[agent] for agent in sim.possible_agents}


def stay(module, entities, **parameters):
    """One step of nobody from hand-placed entities: rewards and costs of the simulator, by agent.

    Bodies with velocity 0 do not move in their first step, whatever pushes them.
    """
    env = module.parallel_env(**parameters)
    options = {"agents": entities[:4], "landmarks": entities[4:]}
    sim = env.batched_groups(1)
    sim.reset(np.arange(1), [0], options)
    _, rewards, _, _, infos = sim.step(nothing(sim))
    costs = {group: infos[group]["cost"] for group in sim.groups}
    env.reset(seed=0, options=options)
    _, env_rewards, _, _, env_infos = env.step(dict.fromkeys(env.agents, 0))
    rewards, costs = by_agent(sim, rewards), by_agent(sim, costs)
    assert {agent: info["cost"] for agent, info in env_infos.items()} == costs
    assert env_rewards == pytest.approx(rewards, rel=1e-6)
    return rewards, costs


def nothing(sim):
    return {g: np.zeros((sim.n_worlds, len(names)), int) for g, names in sim.groups.items()}


def placed(n_entities, **positions):
    """Far apart, except for the entities named by their number (e2=(0.5, 0))."""
    entities = list(FAR[:n_entities])
    for name, position in positions.items():
        entities[int(name[1:])] = position
    return entities


# ---- conformity


@each_id
def test_the_parallel_api_test_passes(env_id):
    parallel_api_test(ENV_IDS[env_id](), num_cycles=200)


@each_id
def test_the_same_seed_gives_the_same_episode(env_id):
    parallel_seed_test(ENV_IDS[env_id], num_cycles=100)


@each_id
def test_pettingzoo_makes_it_by_id_without_wrappers(env_id):
    env = pettingzoo.make("parallel", env_id)
    assert type(env) is type(ENV_IDS[env_id](max_cycles=7))


@each_id
def test_a_pickle_taken_during_an_episode_continues_identically(env_id):
    env = ENV_IDS[env_id](render_mode="rgb_array")
    env.reset(seed=5)
    for _ in range(7):
        env.step(sample(env))
    copy = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(env.render(), copy.render())
    for _ in range(200):
        actions = sample(env)
        results = env.step(actions), copy.step(actions)
        assert gymnasium.utils.env_checker.data_equivalence(*results)
        if not env.agents:
            assert gymnasium.utils.env_checker.data_equivalence(env.reset(), copy.reset())


@each_module
@each_kind
def test_documented_spaces_infos_and_parameters_are_the_real_ones(module, continuous):
    env = module.parallel_env(continuous_actions=continuous)
    text = type(env).__doc__
    sizes = [int(size) for size in re.findall(r"``Box\((\d+),\)``", text)]
    observations, infos = env.reset(seed=3)
    for agent in env.agents:
        role = int(agent in env.metadata["opponents"])
        assert env.observation_space(agent).shape == (sizes[role],)
        assert env.observation_space(agent).contains(observations[agent])
        assert env.observation_space(agent) is env.observation_space(agent)
        assert infos[agent] == {}
    _, rewards, _, _, infos = env.step(sample(env))
    assert all(isinstance(reward, float) for reward in rewards.values())
    assert all(list(info) == ["cost"] for info in infos.values())
    for name in ("max_cycles", "continuous_actions", "cost_with", "render_mode"):
        assert f"| ``{name}`` |" in text


@each_module
def test_the_metadata_declare_roles_and_sums(module):
    env = module.parallel_env()
    metadata = env.metadata
    assert metadata["name"] == module.__name__.rsplit(".", 1)[-1]
    assert (metadata["team_return"], metadata["team_cost"]) == ("sum", "sum")
    assert sorted(metadata["team"] + metadata["opponents"]) == env.possible_agents
    prefix = "adversary" if module is predator_prey_v0 else "agent"
    assert metadata["team"] == [f"{prefix}_{i}" for i in range(3)]


@each_module
def test_an_episode_ends_by_truncation_after_max_cycles(module):
    env = module.parallel_env(max_cycles=5)
    env.reset(seed=0)
    ends = []
    while env.agents:
        _, _, terminated, truncated, _ = env.step(sample(env))
        ends.append((any(terminated.values()), all(truncated.values())))
    assert ends == [(False, False)] * 4 + [(False, True)]
    with pytest.raises(ValueError, match="reset first"):
        env.step({})
    assert module.parallel_env().config.max_cycles == 80


# ---- equal to mpe2


@each_module
@each_kind
@pytest.mark.parametrize("crowd", [None, 0.15], ids=["spread", "crowded"])
def test_every_step_of_the_simulator_equals_mpe2(module, continuous, crowd):
    """All worlds over a whole episode; crowded agents overlap each other and the landmarks."""
    envs = [module.parallel_env(continuous_actions=continuous) for _ in range(4)]
    sim = envs[0].batched_groups(4)
    rng = np.random.default_rng(0)
    options = None
    if crowd:
        points = rng.uniform(-crowd, crowd, (4, len(sim.config.task.bodies), 2))
        options = {"agents": points[:, :4], "landmarks": points[:, 4:]}
    observations, _ = sim.reset(np.arange(4), [3, 4, 5, 6], options)
    for w, env in enumerate(envs):
        own = options and {key: array[w] for key, array in options.items()}
        expected, _ = env.reset(seed=3 + w, options=own)
        for agent, row in by_agent(sim, observations, w).items():
            np.testing.assert_array_equal(row, expected[agent])  # the starts are equal bit by bit
    n_costs = 0
    for t in range(80):
        actions = random_actions(rng, sim)
        observations, rewards, terminated, truncated, infos = sim.step(actions)
        costs = {group: infos[group]["cost"] for group in sim.groups}
        n_costs += costs["team"].sum()
        assert not terminated.any()
        assert truncated.tolist() == [t == 79] * 4
        for w, env in enumerate(envs):
            expected = env.step(by_agent(sim, actions, w))
            for agent, row in by_agent(sim, observations, w).items():
                np.testing.assert_allclose(row, expected[0][agent], rtol=1e-6, atol=1e-12)
            assert by_agent(sim, rewards, w) == pytest.approx(expected[1], rel=1e-6, abs=1e-9)
            assert by_agent(sim, costs, w) == {a: info["cost"] for a, info in expected[4].items()}
            assert expected[3]["agent_0"] == truncated[w]
    assert n_costs > 0 or not crowd


@pytest.mark.parametrize(
    ("module", "name", "parameters"),
    [
        (physical_deception_v0, "simple_adversary_v3", {"N": 3}),
        (predator_prey_v0, "simple_tag_v3", {}),
    ],
)
@each_kind
def test_the_environment_equals_the_one_that_mpe2_ships(module, name, parameters, continuous):
    env = module.parallel_env(continuous_actions=continuous, max_cycles=40)
    mpe2 = import_module(f"mpe2.{name}").parallel_env(
        max_cycles=40, continuous_actions=continuous, **parameters
    )
    assert env.possible_agents == mpe2.possible_agents
    for agent in env.possible_agents:
        assert env.observation_space(agent) == mpe2.observation_space(agent)
        assert env.action_space(agent) == mpe2.action_space(agent)
        env.action_space(agent).seed(0)
    np.testing.assert_equal(env.reset(seed=9), mpe2.reset(seed=9))
    while env.agents:
        # mpe2 gets double precision, too: from single precision it computes another force
        actions = {a: np.asarray(x, float if continuous else int) for a, x in sample(env).items()}
        mine, theirs = env.step(actions), mpe2.step({a: x.copy() for a, x in actions.items()})
        np.testing.assert_equal(mine[:4], theirs[:4])


@pytest.mark.parametrize("depth", [-0.5, -10, -39, -41, -119, -121, -745, -747])
def test_bodies_push_each_other_as_mpe2_has_it_however_far_they_are(depth):
    """Bodies are 0.1 + 0.001 * -depth apart; what is left out further away is below 1e-50."""
    env = keep_away_v0.parallel_env()
    apart = 0.1 - 0.001 * depth
    entities = placed(6, e1=(0.0, 0.0), e2=(0.6 * apart, 0.8 * apart))
    options = {"agents": entities[:4], "landmarks": entities[4:]}
    sim = env.batched_groups(1)
    sim.reset(np.arange(1), [0], options)
    env.reset(seed=0, options=options)
    sim.step(nothing(sim))
    env.step(dict.fromkeys(env.agents, 0))
    expected = [agent.state.p_vel for agent in env._world.world.agents]
    np.testing.assert_allclose(sim.state.velocities[0], expected, rtol=1e-12, atol=1e-50)
    assert (sim.state.velocities[0, 2, 0] > 0) == (depth > -120)


@each_module
def test_starts_are_those_of_mpe2_to_the_last_bit(module):
    env, sim = module.parallel_env(), module.parallel_env().batched_groups(3)
    sim.reset(np.arange(3), [5, 6, 7])
    for w in range(3):
        env.reset(seed=5 + w)
        expected = [entity.state.p_pos for entity in env._world.world.entities]
        np.testing.assert_array_equal(sim.state.positions[w], expected)


def test_keep_away_with_one_good_agent_is_the_push_task_of_mpe2(monkeypatch):
    scenario = import_module("sb3_e2c.envs._particle_keep_away")
    mpe2 = import_module("mpe2.simple_push_v3").parallel_env(max_cycles=20)
    env = keep_away_v0.parallel_env()
    env.reset(seed=0)
    world, theirs = env._world.world, mpe2.unwrapped.world
    for mine, their in ((world.agents[0], theirs.agents[0]), (world.agents[3], theirs.agents[1])):
        names = ("size", "collide", "movable", "max_speed", "accel", "mass", "silent", "adversary")
        assert all(getattr(mine, name) == getattr(their, name) for name in names)
    assert [landmark.collide for landmark in world.landmarks] == [False, False]
    monkeypatch.setattr(scenario, "_N_GOOD", 1)
    small = scenario.raw_env(20, False, None)
    small.reset(seed=4)
    expected, _ = mpe2.reset(seed=4)
    for agent in small.agents:
        np.testing.assert_array_equal(small.observe(agent), expected[agent])


@each_module
def test_bodies_are_those_of_mpe2(module):
    env = module.parallel_env()
    env.reset(seed=0)
    for body, entity in zip(env.task.bodies, env._world.world.entities, strict=True):
        assert (body.size, body.collides) == (entity.size, entity.collide)
        assert body.max_speed == (entity.max_speed or np.inf)
        assert body.acceleration == (entity.accel or 5.0)
        assert entity.mass == 1.0


# ---- the simulator


@each_module
def test_groups_name_the_agents_and_observations_have_their_native_width(module):
    sim = module.parallel_env().batched_groups(5)
    observations, infos = sim.reset(np.arange(5), range(5))
    assert sim.groups == {key: sim.metadata[key] for key in ("team", "opponents")}
    assert infos == {"team": {}, "opponents": {}}
    for group, names in sim.groups.items():
        shape = (5, len(names), sim.observation_sizes[group])
        assert observations[group].shape == shape
        assert all(sim.observation_space(name).shape == shape[2:] for name in names)
    observations, rewards, _, _, infos = sim.step(nothing(sim))
    assert all(len(rewards[group][0]) == len(names) for group, names in sim.groups.items())
    assert infos["opponents"]["cost"].tolist() == [[0.0]] * 5


def test_the_next_episode_of_a_world_continues_its_stream():
    env, sim = keep_away_v0.parallel_env(), keep_away_v0.parallel_env().batched_groups(2)
    sim.reset(np.arange(2), [1, 2])
    before = sim.state.positions.copy()
    env.reset(seed=2)
    for _ in range(3):
        expected, _ = env.reset()
        observations, _ = sim.reset(np.array([1]), [None])
        for agent, row in by_agent(sim, observations).items():
            np.testing.assert_array_equal(row, expected[agent])
    np.testing.assert_array_equal(sim.state.positions[0], before[0])


@each_module
@each_kind
def test_a_world_behaves_the_same_whatever_the_number_of_worlds(module, continuous):
    env = module.parallel_env(continuous_actions=continuous, max_cycles=30)
    many, alone = env.batched_groups(9), [env.batched_groups(1) for _ in range(9)]
    found = [many.reset(np.arange(9), range(9))]
    expected = [[sim.reset(np.arange(1), [w]) for w, sim in enumerate(alone)]]
    rng = np.random.default_rng(0)
    for _ in range(30):
        actions = random_actions(rng, many)
        own = [{g: array[[w]] for g, array in actions.items()} for w in range(9)]
        found.append(many.step(actions))
        expected.append([sim.step(each) for sim, each in zip(alone, own, strict=True)])
    ended = np.array([7, 2])
    found.append(many.reset(ended, [None, 11]))
    expected.append([alone[7].reset(np.arange(1), [None]), alone[2].reset(np.arange(1), [11])])
    for joint, single in zip(found, expected, strict=True):
        observations, infos = joint[0], joint[-1]
        for group in many.groups:
            rows = [answer[0][group] for answer in single]
            np.testing.assert_array_equal(observations[group], np.concatenate(rows))
            for key, column in infos[group].items():
                rows = [answer[-1][group][key] for answer in single]
                np.testing.assert_array_equal(column, np.concatenate(rows))


def test_no_world_can_be_reset_either():
    observations, _ = keep_away_v0.parallel_env().batched_groups(2).reset(np.arange(0), [])
    assert {g: array.shape for g, array in observations.items()} == {
        "team": (0, 3, 23),
        "opponents": (0, 1, 12),
    }


def test_options_do_not_touch_the_stream():
    first, second = (physical_deception_v0.parallel_env() for _ in range(2))
    first.reset(seed=0, options={"goal": 2, "agents": FAR[:4]})
    second.reset(seed=0)
    np.testing.assert_equal(first.reset(), second.reset())


def test_a_pickled_simulator_continues_identically():
    sim = predator_prey_v0.parallel_env().batched_groups(3)
    sim.reset(np.arange(3), [0, 1, 2])
    rng = np.random.default_rng(0)
    sim.step(random_actions(rng, sim))
    copy = pickle.loads(pickle.dumps(sim))
    actions = random_actions(rng, sim)
    np.testing.assert_equal(sim.step(actions), copy.step(actions))
    np.testing.assert_equal(
        sim.reset(np.arange(3), [None] * 3), copy.reset(np.arange(3), [None] * 3)
    )


def test_a_pickle_of_an_older_version_gets_the_tables_of_this_one():
    sim = keep_away_v0.parallel_env().batched_groups(1)
    sim.reset(np.arange(1), [0])
    old = pickle.loads(pickle.dumps(sim))
    old._rules = ("tables", "of", "another", "version")
    np.testing.assert_equal(
        pickle.loads(pickle.dumps(old)).step(nothing(sim)), sim.step(nothing(sim))
    )


def test_returned_arrays_belong_to_the_caller():
    sim = keep_away_v0.parallel_env().batched_groups(2)
    sim.reset(np.arange(2), [0, 1])
    first = sim.step(nothing(sim))
    kept = pickle.loads(pickle.dumps(first))
    sim.step(random_actions(np.random.default_rng(0), sim))
    np.testing.assert_equal(first, kept)


def test_the_simulator_and_its_environment_need_no_mpe2_until_a_world_is_stepped():
    code = (
        "import sys, numpy as np\n"
        "from sb3_e2c.envs import predator_prey_v0\n"
        "env = predator_prey_v0.parallel_env()\n"
        "sim = env.batched_groups(2); sim.reset(np.arange(2), [0, 1])\n"
        "assert not {'mpe2', 'pygame', 'pygame_ce'} & set(sys.modules)\n"
        "env.reset(seed=0)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert result.stdout == b""  # pygame would greet


# ---- costs


@pytest.mark.parametrize(
    ("module", "touch", "apart"),
    [
        (physical_deception_v0, 0.29, 0.30001),
        (keep_away_v0, 0.09, 0.10001),
        (predator_prey_v0, 0.14, 0.15001),
    ],
)
def test_teammates_cost_both_when_closer_than_the_sum_of_their_sizes(module, touch, apart):
    n = len(module.parallel_env().task.bodies)
    first, second = (0, 1) if module is predator_prey_v0 else (1, 2)
    for distance, cost in ((touch, 1.0), (apart, 0.0)):
        close = {f"e{first}": (1.0, 1.0), f"e{second}": (1.0, 1.0 - distance)}
        _, costs = stay(module, placed(n, **close))
        assert [costs[agent] for agent in module.parallel_env().metadata["team"]] == [cost, cost, 0]


def test_exactly_the_sum_of_sizes_is_no_contact():
    _, costs = stay(physical_deception_v0, placed(7, e1=(0.0, 0.0), e2=(0.0, 0.15 + 0.15)))
    assert set(costs.values()) == {0.0}


def test_contact_with_two_costs_one():
    _, costs = stay(keep_away_v0, placed(6, e1=(0, 0), e2=(0.09, 0), e3=(-0.09, 0)))
    assert costs == {"adversary_0": 0, "agent_0": 1, "agent_1": 1, "agent_2": 1}


def test_obstacles_cost_in_predator_prey_unless_left_out():
    for distance, cost in ((0.27, 1.0), (0.27501, 0.0)):
        entities = placed(6, e4=(1.0, 1.0), e2=(1.0 + distance, 1.0))
        _, costs = stay(predator_prey_v0, entities)
        assert costs == {"adversary_0": 0, "adversary_1": 0, "adversary_2": cost, "agent_0": 0}
        _, costs = stay(predator_prey_v0, entities, cost_with=["teammates"])
        assert set(costs.values()) == {0.0}


@each_module
def test_the_adversary_counts_on_request_and_never_pays(module):
    n = len(module.parallel_env().task.bodies)
    agent, opponent = (0, 3) if module is predator_prey_v0 else (1, 0)
    entities = placed(n, **{f"e{agent}": (1.0, 1.0), f"e{opponent}": (1.0, 1.09)})
    _, costs = stay(module, entities)
    assert set(costs.values()) == {0.0}
    _, costs = stay(module, entities, cost_with={"adversary"})
    team = module.parallel_env().metadata["team"]
    assert {name for name, cost in costs.items() if cost} == {team[0]}


@pytest.mark.parametrize("module", [physical_deception_v0, keep_away_v0])
def test_goals_are_no_obstacles(module):
    with pytest.raises(ValueError, match="are no obstacles; leave 'obstacles' out"):
        module.parallel_env(cost_with=["teammates", "obstacles"])


# ---- rewards


def test_a_touch_of_the_prey_pays_every_predator():
    rewards, _ = stay(predator_prey_v0, placed(6, e0=(0.5, 0.1), e1=(0.5, -0.1), e3=(0.5, 0)))
    assert rewards == pytest.approx({f"adversary_{i}": 20 for i in range(3)} | {"agent_0": -20})


def test_the_prey_pays_for_leaving():
    rewards, _ = stay(predator_prey_v0, placed(6, e3=(0.95, -1.5)))
    assert rewards["agent_0"] == pytest.approx(-0.5 - np.e)


def test_deception_is_shared_and_keep_away_is_not():
    # distances to the goal (0, 0): adversary 3; team 3, 1, 4
    entities = placed(6, e1=(3, 0), e2=(0, 1), e3=(0, -4), e4=(0, 0))
    rewards = {}
    for module, more in ((physical_deception_v0, FAR[6:]), (keep_away_v0, [])):
        sim = module.parallel_env().batched_groups(1)
        options = {"agents": entities[:4], "landmarks": entities[4:] + more, "goal": 0}
        sim.reset(np.arange(1), [0], options)
        rewards[module] = by_agent(sim, sim.step(nothing(sim))[1])
    assert list(rewards[physical_deception_v0].values()) == pytest.approx([-3, 2, 2, 2])
    assert list(rewards[keep_away_v0].values()) == pytest.approx([1 - 3, -3, -1, -4])


# ---- magnitudes of a random team, 40 episodes of mpe2 when they were first measured


@pytest.mark.parametrize(
    ("module", "cost", "team_return"),
    [(physical_deception_v0, 13.3, 150), (keep_away_v0, 1.4, -313), (predator_prey_v0, 6.2, 20)],
)
def test_a_random_team_costs_and_earns_what_was_measured(module, cost, team_return):
    n = 1000
    sim = module.parallel_env().batched_groups(n)
    sim.reset(np.arange(n), range(n))
    rng = np.random.default_rng(0)
    returns, costs = np.zeros((2, n))
    for _ in range(80):
        _, rewards, _, _, infos = sim.step(random_actions(rng, sim))
        returns += rewards["team"].sum(axis=1)
        costs += infos["team"]["cost"].sum(axis=1)
    for values, measured in ((costs, cost), (returns, team_return)):
        assert abs(values.mean() - measured) < 3 * values.std() * np.sqrt(1 / 40 + 1 / n)


# ---- pictures


@each_module
def test_the_simulator_draws_what_mpe2_draws(module):
    env = module.parallel_env(render_mode="rgb_array")
    sim = env.batched_groups(2)
    sim.reset(np.arange(2), [0, 1])
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = random_actions(rng, sim)
        sim.step(actions)
        env.step(by_agent(sim, actions, 1))
    frame = env.render()
    assert frame.shape == (700, 700, 3)
    assert frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 3
    np.testing.assert_array_equal(sim.render(1), frame)


@pytest.mark.parametrize("goal", [0, 1])
def test_landmarks_do_not_look_like_agents(goal):
    env = keep_away_v0.parallel_env(render_mode="rgb_array")
    env.reset(
        seed=0, options={"goal": goal, "agents": FAR[:4], "landmarks": [(0.5, -1), (-1, 0.5)]}
    )
    frame = env.render()
    reach = max(np.abs(FAR[:4]).max(), 1.0)
    for x, y in np.array([(0.5, -1), (-1, 0.5)]) / reach * 0.9:
        assert (frame[int(350 * (1 - y)), int(350 * (1 + x))] == 255).all()
    for x, y in np.array(FAR[:4]) / reach * 0.9:
        assert not (frame[int(350 * (1 - y)), int(350 * (1 + x))] == 255).all()


# ---- errors


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"max_cycles": 0}, "max_cycles is 0; expected an integer of at least 1"),
        ({"max_cycles": 8.0}, "max_cycles is 8.0"),
        ({"continuous_actions": 1}, "continuous_actions is 1; expected True or False"),
        ({"cost_with": "teammates"}, "cost_with is 'teammates'; expected a list"),
        ({"cost_with": []}, "with at least one of"),
        ({"cost_with": ["walls"]}, r"cost_with is \['walls'\]"),
        ({"render_mode": "human"}, "render_mode is 'human'; expected None or 'rgb_array'"),
    ],
)
def test_wrong_parameters_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        predator_prey_v0.parallel_env(**parameters)


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        (PREDATOR_PREY, {"goal": 0}, "expects no goal"),
        (KEEP_AWAY, {"goal": 2}, "expects a landmark, 0 to 1"),
        (KEEP_AWAY, {"agents": FAR[:3]}, r"has shape \(3, 2\); expected finite numbers, \(4, 2\)"),
        (PHYSICAL_DECEPTION, {"landmarks": [[np.nan] * 2] * 3}, "expected finite numbers"),
        (KEEP_AWAY, {"agents": [(0, 0)] * 4}, "expected different points"),
    ],
)
def test_wrong_placements_are_refused_by_both(task, options, message):
    env = next(module.parallel_env() for module in MODULES if module.__name__.endswith(task.name))
    resets = (env.reset, partial(env.batched_groups(1).reset, np.arange(1), [0]))
    for reset in resets:
        with pytest.raises(ValueError, match=message):
            reset(options=options)


def test_wrong_actions_are_refused_by_both():
    env = keep_away_v0.parallel_env()
    sim = env.batched_groups(2)
    with pytest.raises(ValueError, match=r"world\(s\) \[0, 1\] has ended or not begun"):
        sim.step(nothing(sim))
    sim.reset(np.arange(2), [0, 1])
    with pytest.raises(ValueError, match="actions have no 'opponents'"):
        sim.step({"team": np.zeros((2, 3), int)})
    with pytest.raises(ValueError, match=r"of the team have shape \(2, 2\); expected \(2, 3\)"):
        sim.step(nothing(sim) | {"team": np.zeros((2, 2), int)})
    with pytest.raises(ValueError, match="of the team are float64; expected integers"):
        sim.step(nothing(sim) | {"team": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="action of agent_2 in world 1 is 5; expected one of 0"):
        sim.step(nothing(sim) | {"team": np.array([[0, 0, 0], [0, 0, 5]])})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action of agent_1 is 5; expected one of 0"):
        env.step(dict.fromkeys(env.agents, 0) | {"agent_1": 5})
    with pytest.raises(ValueError, match=r"no action for \['agent_2'\]"):
        env.step(dict.fromkeys(env.agents[:3], 0))
    sim = keep_away_v0.parallel_env(continuous_actions=True).batched_groups(1)
    sim.reset(np.arange(1), [0])
    actions = {"team": np.full((1, 3, 5), np.nan), "opponents": np.zeros((1, 1, 5))}
    with pytest.raises(ValueError, match="expected five finite numbers"):
        sim.step(actions)


def test_pictures_need_a_mode_and_an_episode():
    with pytest.raises(ValueError, match="render_mode='rgb_array'"):
        keep_away_v0.parallel_env().render()
    with pytest.raises(ValueError, match="reset first"):
        keep_away_v0.parallel_env(render_mode="rgb_array").render()


def test_without_mpe2_the_extra_is_named(monkeypatch):
    real_import = builtins.__import__

    def without_mpe2(name, *args, **kwargs):
        if name.split(".")[0] == "mpe2":
            raise ImportError("No module named 'mpe2'")
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_mpe2)
    for name in [name for name in sys.modules if name.split(".")[0] == "mpe2"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mpe2", None)
    with pytest.raises(ImportError, match=re.escape("pip install sb3-e2c[envs]")):
        predator_prey_v0.parallel_env().reset()


def test_closing_one_world_leaves_the_others_alone():
    first, second = (keep_away_v0.parallel_env(render_mode="rgb_array") for _ in range(2))
    first.reset(seed=0)
    second.reset(seed=0)
    first.close()
    second.step(sample(second))
    assert second.render().shape == (700, 700, 3)
