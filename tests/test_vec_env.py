"""The VecEnv contract, for every way to run the worlds, and what SuperSuit's own adapter does."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
import warnings

import gymnasium as gym
import numpy as np
import pytest
import supersuit as ss
from conftest import AGENTS, FAST, SLOW, TwoOnALine
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import parallel_to_aec
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from sb3_e2c.envs import multi_rover_v0
from sb3_e2c.vec_env import share_parameters

WAYS = {
    "one process": {"backend": "supersuit"},
    "two processes": {"backend": "supersuit", "n_processes": 2},
    "batched": {"backend": "batched"},
}
SLOW_AND_FAST = np.array([SLOW, FAST])


@pytest.fixture(params=WAYS)
def make(request):
    """Makes the worlds in one of the ways, and closes them."""
    made = []

    def build(env=TwoOnALine, n_worlds=2, seed=0, **parameters):
        make_env = lambda: env(**parameters)  # noqa: E731
        made.append(share_parameters(make_env, n_worlds, seed=seed, **WAYS[request.param]))
        return made[-1]

    build.way = request.param
    yield build
    for venv in made:
        venv.close()


def run(venv, n_steps, actions=SLOW_AND_FAST):
    """Reset, then all agents act alike in all worlds; returns what the last step returned."""
    venv.reset()
    for _ in range(n_steps):
        outcome = venv.step(np.tile(actions, venv.n_worlds))
    return outcome


def same(left, right):
    """Equal down to the last bit, through lists, tuples, dicts and arrays."""
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[k], right[k]) for k in left)
    if isinstance(left, (list, tuple)) and not np.isscalar(left[0] if len(left) else 0):
        return len(left) == len(right) and all(map(same, left, right))
    return np.array_equal(left, right)


class TestContract:
    def test_slot_is_world_times_agents_plus_agent(self, make):
        venv = make(n_worlds=3)
        assert (venv.num_envs, venv.n_worlds, venv.n_agents) == (6, 3, 2)
        assert venv.agents == AGENTS
        # own position, teammate's position, time
        assert venv.reset().tolist() == [[0, 1, 0], [1, 0, 0]] * 3
        observations, *_ = venv.step(np.array([SLOW, SLOW, FAST, SLOW, FAST, FAST]))
        assert observations[::2].tolist() == [[1, 2, 1], [2, 2, 1], [2, 3, 1]]

    def test_it_is_a_stable_baselines3_vec_env(self, make):
        venv = make()
        assert isinstance(venv, VecEnv)
        assert venv.unwrapped is venv
        assert venv.observation_space == spaces.Box(0.0, np.inf, (3,))
        assert venv.action_space == spaces.Discrete(2)
        assert venv.env_is_wrapped(gym.Wrapper) == [False] * 4
        assert venv.env_is_wrapped(gym.Wrapper, indices=[1, 2]) == [False] * 2

    def test_worlds_differ_under_one_seed_and_the_same_seed_repeats(self, make):
        venv = make(n_worlds=4, seed=7, spread=10**6)
        first = venv.reset()
        expected = [np.random.default_rng(7 + world).integers(10**6) for world in range(4)]
        assert first[::2, 0].tolist() == expected
        venv.seed(7)
        assert same(venv.reset(), first)
        assert not same(venv.reset(), first)  # seeds are used once, then the streams go on

    def test_seeds_belong_to_worlds(self, make):
        venv = make(n_worlds=3)
        assert venv.seed(5) == [5, 5, 6, 6, 7, 7]
        np.random.seed(1)
        drawn = venv.seed(None)
        assert [seed - drawn[0] for seed in drawn] == [0, 0, 1, 1, 2, 2]
        np.random.seed(1)
        assert venv.seed(None) == drawn

    def test_a_next_episode_continues_the_stream_of_its_world(self, make):
        observations, *_ = run(make(n_worlds=2, seed=3, spread=10**6, length=1), n_steps=2)
        streams = [np.random.default_rng(3 + world) for world in range(2)]
        expected = [[rng.integers(10**6) for _ in range(3)][-1] for rng in streams]
        assert observations[::2, 0].tolist() == expected

    def test_rewards_are_fresh_float32_that_a_callback_may_edit(self, make):
        venv = make(length=9)
        rewards = run(venv, 1)[1]
        assert rewards.dtype == np.float32
        assert rewards.tolist() == [1, 2, 1, 2]
        rewards[:] = -1
        assert venv.step(np.tile(SLOW_AND_FAST, 2))[1].tolist() == [1, 2, 1, 2]
        assert rewards.tolist() == [-1] * 4

    def test_dones_are_booleans_and_a_world_ends_with_all_its_slots(self, make):
        venv = make(length=3)
        venv.set_options([{"length": 2}] * 2 + [{}] * 2)
        dones = run(venv, 2)[2]
        assert dones.dtype == np.bool_
        assert dones.tolist() == [True, True, False, False]

    def test_the_last_observation_and_the_first_of_the_next_episode_both_arrive(self, make):
        venv = make(length=2)
        venv.set_options([{"length": 1}] * 2 + [{}] * 2)
        observations, _, _, infos = run(venv, 1)
        assert observations.tolist() == [[0, 1, 0], [1, 0, 0], [1, 3, 1], [3, 1, 1]]
        assert infos[0]["terminal_observation"].tolist() == [1, 3, 1]
        assert infos[1]["terminal_observation"].tolist() == [3, 1, 1]
        assert "terminal_observation" not in infos[2]
        observations[:] = -1
        assert infos[0]["terminal_observation"].tolist() == [1, 3, 1]

    @pytest.mark.parametrize(
        ("end", "flag"), [("truncated", True), ("terminated", False), ("both", False)]
    )
    def test_a_time_limit_is_told_from_a_true_end(self, make, end, flag):
        infos = run(make(length=2, end=end), 2)[3]
        assert [info["TimeLimit.truncated"] for info in infos] == [flag] * 4
        assert type(infos[0]["TimeLimit.truncated"]) is bool

    def test_costs_of_the_last_step_arrive(self, make):
        infos = run(make(length=2, agent_costs=(1.0, 3.0)), 2)[3]
        assert [info["cost"] for info in infos] == [0, 3, 0, 3]

    def test_reset_infos_are_those_of_the_episode_that_just_began(self, make):
        venv = make(seed=1, spread=10**6, length=2)
        venv.reset()
        first = venv.reset()
        assert [info["start"] for info in venv.reset_infos] == first[[0, 0, 2, 2], 0].tolist()
        venv.step(np.tile(SLOW_AND_FAST, 2))
        assert [info["start"] for info in venv.reset_infos] == first[[0, 0, 2, 2], 0].tolist()
        second, _, _, infos = venv.step(np.tile(SLOW_AND_FAST, 2))
        assert [info["start"] for info in venv.reset_infos] == second[[0, 0, 2, 2], 0].tolist()
        assert "start" not in infos[0]

    def test_every_slot_has_infos_of_its_own(self, make):
        venv = make(n_costs=0)
        for infos in (run(venv, 1)[3], venv.reset_infos):
            infos[0]["note"] = 1
            assert ["note" in info for info in infos] == [True, False, False, False]

    def test_options_are_passed_once_and_per_world(self, make):
        venv = make(length=1)
        venv.set_options({"start": 7})
        assert venv.reset()[::2, 0].tolist() == [7, 7]
        assert venv.reset()[::2, 0].tolist() == [0, 0]
        venv.set_options([{"start": 7}, {}, {}, {}])  # of each world its first slot's
        assert venv.reset()[::2, 0].tolist() == [7, 0]
        assert venv.step(np.zeros(4, int))[0][::2, 0].tolist() == [0, 0]  # the next episode's
        with pytest.raises(ValueError, match="list of 2; expected one dict, or one for each of"):
            venv.set_options([{}, {}])

    def test_render_mode_and_metadata_are_known(self, make):
        venv = make(render_mode="rgb_array")
        assert venv.render_mode == "rgb_array"
        assert venv.get_attr("render_mode", indices=[0, 3]) == ["rgb_array"] * 2
        assert venv.metadata["render_fps"] == 5
        assert venv.get_attr("metadata")[3]["name"] == "two_on_a_line_v0"
        assert venv.has_attr("render_mode")
        assert not venv.has_attr("nothing_of_this_name")

    def test_team_rules_come_from_the_environment_or_the_caller(self, make):
        assert (make(shared=True).team_return, make(team_cost="max").team_cost) == ("shared", "max")
        venv = share_parameters(TwoOnALine, 1, team_return="shared", team_cost="max")
        assert (venv.team_return, venv.team_cost) == ("shared", "max")
        with pytest.raises(
            ValueError, match=r"team_cost is 'mean'; expected one of \('sum', 'max'\)"
        ):
            share_parameters(TwoOnALine, 1, team_cost="mean")

    def test_the_size_of_the_critic_state_is_known_before_the_first_reset(self, make):
        assert (make().critic_state_dim, make(critic_state=True).critic_state_dim) == (0, 1)

    def test_a_wrong_number_of_actions_is_refused(self, make):
        venv = make()
        venv.reset()
        with pytest.raises(ValueError, match=r"shape \(3,\); expected 4 rows"):
            venv.step(np.zeros(3, int))

    def test_closing_is_quick_and_repeatable(self, make):
        venv = make()
        run(venv, 1)
        start = time.monotonic()
        venv.close()
        venv.close()
        assert time.monotonic() - start < 2
        assert not multiprocessing.active_children()
        with pytest.raises(RuntimeError, match="is closed; make a new one"):
            venv.reset()

    def test_ppo_trains_with_a_seed(self, make):
        weights = []
        for _ in range(2):
            venv = VecNormalize(VecMonitor(make(spread=9)))
            model = PPO(
                "MlpPolicy", venv, n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu"
            )
            model.learn(64)
            weights.append(model.policy.state_dict())
        assert all(same(weights[0][name], weights[1][name]) for name in weights[0])

    def test_all_ways_give_the_same_trajectories(self, make):
        parameters = {"length": 3, "spread": 99, "n_costs": 2, "critic_state": True, "n_worlds": 3}
        reference = share_parameters(
            lambda: TwoOnALine(length=3, spread=99, n_costs=2, critic_state=True),
            3,
            seed=11,
            backend="supersuit",
        )
        assert_same_trajectories(make(seed=11, **parameters), reference, n_steps=10)

    def test_all_ways_give_the_same_rovers(self, make):
        # One world sees some captures; episodes of 7 steps end twice in 20 steps.
        rovers = {
            "n_rovers": 3,
            "coupling": 1,
            "dim": 8.0,
            "max_cycles": 7,
            "add_critic_state": True,
        }
        venv = make(multi_rover_v0.parallel_env, n_worlds=3, seed=2, **rovers)
        reference = share_parameters(
            lambda: multi_rover_v0.parallel_env(**rovers), 3, seed=2, backend="supersuit"
        )
        assert venv.critic_state_dim == 2
        assert_same_trajectories(venv, reference, n_steps=20)


def assert_same_trajectories(venv, reference, n_steps):
    reference.action_space.seed(0)
    assert same(venv.reset(), reference.reset())
    assert same(venv.reset_infos, reference.reset_infos)
    for _ in range(n_steps):
        actions = np.array([reference.action_space.sample() for _ in range(venv.num_envs)])
        assert same(venv.step(actions), reference.step(actions))
        assert same(venv.reset_infos, reference.reset_infos)


class TestAttributes:
    @pytest.fixture(params=["supersuit", "batched"])
    def venv(self, request):
        venv = share_parameters(lambda: TwoOnALine(length=9), 2, backend=request.param)
        venv.reset()
        return venv

    def test_slots_read_their_world(self, venv):
        assert len(venv.get_attr("gains")) == 4
        assert venv.get_attr("possible_agents", indices=3) == [AGENTS]
        assert venv.has_attr("gains")
        assert not venv.has_attr("color")

    def test_slots_write_their_world(self, venv):
        venv.set_attr("color", "red")
        assert venv.get_attr("color") == ["red"] * 4

    def test_a_method_is_called_once_for_a_world(self, venv):
        calls = []
        owners = {id(venv.worlds.owner(world)): venv.worlds.owner(world) for world in range(2)}
        for owner in owners.values():
            owner.ping = lambda word: calls.append(word) or len(calls)
        answers = venv.env_method("ping", "hello")
        assert len(calls) == len(owners)
        assert len(answers) == 4
        assert answers[:2] == [1, 1]

    def test_worlds_can_be_told_apart_through_supersuit_only(self, venv):
        if venv.worlds.owner(0) is venv.worlds.owner(1):
            with pytest.raises(ValueError, match=r"names 1 of 2 worlds, but batched worlds share"):
                venv.set_attr("color", "red", indices=[0, 1])
            return
        venv.set_attr("color", "red", indices=[0, 1])
        venv.set_attr("color", "blue", indices=[2])
        assert venv.get_attr("color") == ["red", "red", "blue", "blue"]

    def test_worker_processes_say_that_worlds_are_out_of_reach(self):
        venv = share_parameters(TwoOnALine, 2, n_processes=2, backend="supersuit")
        for call in (
            lambda: venv.get_attr("gains"),
            lambda: venv.set_attr("gains", 1),
            lambda: venv.env_method("state"),
            venv.get_images,
        ):
            with pytest.raises(AttributeError, match="out of reach; use n_processes=1"):
                call()
        assert not venv.has_attr("gains")
        venv.close()

    def test_pictures_are_one_for_each_world(self):
        for backend in ("supersuit", "batched"):
            make_env = lambda: TwoOnALine(spread=200, render_mode="rgb_array")  # noqa: E731
            venv = share_parameters(make_env, 4, backend=backend)
            starts = venv.reset()[::2, 0]
            assert [image[0, 0, 0] for image in venv.get_images()] == starts.tolist()
            assert venv.render().shape == (4, 6, 3)  # 2 x 2 tiles of (2, 3)

    def test_batched_worlds_survive_a_pickle_with_their_streams(self):
        venv = share_parameters(lambda: TwoOnALine(length=2, spread=99), 3)
        run(venv, 1)
        copy = pickle.loads(pickle.dumps(venv))
        for _ in range(5):
            actions = np.tile(SLOW_AND_FAST, 3)
            assert same(venv.step(actions), copy.step(actions))


class Variant(BaseParallelWrapper):
    """The line, with something unusual about it."""

    def __init__(self, **parameters):
        super().__init__(TwoOnALine(**parameters))


class Float64(Variant):
    def observation_space(self, agent):
        return spaces.Box(-np.finfo(np.float64).max, np.inf, (3,), np.float64)

    def step(self, actions):
        observations, *rest = super().step(actions)
        return {agent: row + 1e-9 for agent, row in observations.items()}, *rest


class SharedInfo(Variant):
    """As multi-agent MuJoCo: one info for all, no render mode, patched time limits."""

    def __getattr__(self, name):
        if name in ("render_mode", "unwrapped"):
            raise AttributeError(name)
        return super().__getattr__(name)

    @property
    def unwrapped(self):
        return self

    def step(self, actions):
        *rest, _ = super().step(actions)
        info = {"speed": 3.0, "TimeLimit.truncated": "whatever the wrapper says"}
        return *rest, dict.fromkeys(AGENTS, info)


class Disordered(Variant):
    """Agents in another order, and no infos at the end."""

    def step(self, actions):
        *answers, infos = super().step(actions)
        answers = [{agent: d[agent] for agent in reversed(AGENTS)} for d in answers]
        return *answers, infos if self.env.agents else {}


class EndsEarly(Variant):
    def step(self, actions):
        *rest, terminated, truncated, infos = super().step(actions)
        return *rest, {**terminated, "agent_1": self.env.t == 2}, truncated, infos


class Vanishes(Variant):
    def step(self, actions):
        return tuple({"agent_0": answer["agent_0"]} for answer in super().step(actions))


class Fails(Variant):
    def step(self, actions):
        raise ZeroDivisionError("the rover fell off the edge")


class Unequal(Variant):
    def observation_space(self, agent):
        return spaces.Box(0.0, 1.0, (3 + AGENTS.index(agent),))


class UnequalActions(Variant):
    def action_space(self, agent):
        return spaces.Discrete(2 + AGENTS.index(agent))


class Tile(ParallelEnv):
    """Discrete observations, actions of any kind; the observation is the sum of the action."""

    render_mode = None

    def __init__(self, actions):
        self.actions, self.metadata = actions, {}
        self.agents = self.possible_agents = AGENTS

    def observation_space(self, agent):
        return spaces.Discrete(50)

    def action_space(self, agent):
        return self.actions

    def reset(self, seed=None, options=None):
        return dict.fromkeys(AGENTS, 0), {}

    def step(self, actions):
        assert all(self.actions.contains(action) for action in actions.values())
        no = dict.fromkeys(AGENTS, False)
        return {a: int(np.sum(x)) for a, x in actions.items()}, dict.fromkeys(AGENTS, 1), no, no, {}


@pytest.fixture(params=[1, 2], ids=["one process", "two processes"])
def shared(request):
    """``share_parameters`` through SuperSuit, closed at the end."""
    made = []

    def build(make_env, n_worlds=2):
        made.append(share_parameters(make_env, n_worlds, n_processes=request.param))
        return made[-1]

    if request.param == 2:
        build.workers = lambda: made[-1].worlds.vec.procs
    yield build
    for venv in made:
        venv.close()


class TestUnusualEnvironments:
    def test_float64_observations_become_float32(self, shared):
        venv = shared(lambda: Float64(length=1))
        assert venv.observation_space.dtype == np.float32
        assert venv.observation_space.low.tolist() == [-np.inf] * 3
        observations, _, _, infos = run(venv, 1)
        assert observations.dtype == infos[0]["terminal_observation"].dtype == np.float32

    def test_one_info_for_all_agents_and_no_render_mode(self, shared):
        venv = shared(lambda: SharedInfo(length=1))
        assert venv.render_mode is None
        infos = run(venv, 1)[3]
        assert infos[0]["terminal_observation"].tolist() == [1, 3, 1]
        assert infos[1]["terminal_observation"].tolist() == [3, 1, 1]
        assert [info["TimeLimit.truncated"] for info in infos] == [True] * 4

    def test_patched_time_limits_say_nothing_before_the_end(self, shared):
        assert run(shared(lambda: SharedInfo(length=9)), 1)[3] == [{"speed": 3.0}] * 4

    def test_agents_in_another_order_and_missing_infos(self, shared):
        _, rewards, _, infos = run(shared(lambda: Disordered(length=1)), 1)
        assert rewards.tolist() == [1, 2, 1, 2]
        assert infos[1]["terminal_observation"].tolist() == [3, 1, 1]

    @pytest.mark.parametrize(
        ("space", "actions", "sums"),
        [
            (spaces.Discrete(5), [4, 1, 2, 0], [4, 1, 2, 0]),
            (spaces.MultiDiscrete([5, 9]), [[4, 8], [0, 1], [1, 1], [2, 5]], [12, 1, 2, 7]),
            (spaces.Box(0, 9, (2,)), [[4.0, 8.0], [0, 1], [1, 1], [2, 5]], [12, 1, 2, 7]),
        ],
        ids=["discrete", "multidiscrete", "box"],
    )
    def test_all_kinds_of_actions_and_discrete_observations(self, shared, space, actions, sums):
        venv = shared(lambda: Tile(space))
        assert venv.reset().tolist() == [0] * 4
        assert venv.step(np.array(actions, dtype=space.dtype))[0].tolist() == sums

    def test_an_agent_that_ends_before_the_others_is_refused(self, shared):
        venv = shared(lambda: EndsEarly(length=4))
        with pytest.raises(
            ValueError, match=r"\['agent_1'\] of world 0 ended while \['agent_0'\] go"
        ):
            run(venv, 2)

    def test_an_agent_that_vanishes_is_refused(self, shared):
        with pytest.raises(
            ValueError, match=r"nothing for the agents \['agent_1'\]; expected all of"
        ):
            run(shared(Vanishes), 1)

    def test_an_error_in_a_world_arrives_with_its_message(self, shared):
        with pytest.raises(ZeroDivisionError, match="the rover fell off the edge"):
            run(shared(Fails), 1)

    def test_particles_of_mpe2_run(self, shared):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pygame's packaging
            from mpe2 import simple_spread_v3
        venv = shared(lambda: simple_spread_v3.parallel_env(N=3, max_cycles=5))
        first = venv.reset()
        assert first.shape == (6, 18)
        assert not same(first[:3], first[3:])
        venv.seed(0)
        assert same(venv.reset(), first)


class TestWorkers:
    @pytest.mark.parametrize("when", ["before a step", "during a step", "before a reset"])
    def test_a_killed_worker_is_an_error_and_not_a_hang(self, when):
        venv = share_parameters(TwoOnALine, 4, n_processes=2)
        venv.reset()
        if when == "during a step":
            os.kill(venv.worlds.vec.procs[1].pid, signal.SIGSTOP)
            venv.step_async(np.zeros(8, int))
        os.kill(venv.worlds.vec.procs[1].pid, signal.SIGKILL)
        start = time.monotonic()
        call = {
            "before a step": lambda: venv.step(np.zeros(8, int)),
            "during a step": venv.step_wait,
            "before a reset": venv.reset,
        }[when]
        with pytest.raises(
            RuntimeError, match=r"worker process 1 \(worlds 2 to 3\) ended with exit"
        ):
            call()
        assert time.monotonic() - start < 5
        assert not multiprocessing.active_children()
        with pytest.raises(RuntimeError, match="stopped by an earlier error in a worker"):
            venv.reset()
        venv.close()

    def test_worlds_need_not_divide_evenly_among_workers(self):
        venv = share_parameters(lambda: TwoOnALine(spread=10**6), 3, n_processes=2)
        expected = share_parameters(lambda: TwoOnALine(spread=10**6), 3)
        assert_same_trajectories(venv, expected, n_steps=6)
        venv.close()

    def test_a_world_that_cannot_be_made_leaves_no_worker_behind(self, capfd):
        parent = os.getpid()

        def make_env():
            if os.getpid() != parent:
                raise FileNotFoundError("no map of the line")
            return TwoOnALine()

        with pytest.raises(FileNotFoundError, match="no map of the line"):
            share_parameters(make_env, 2, n_processes=2)
        assert not multiprocessing.active_children()

    def test_worlds_are_closed_inside_the_workers(self, tmp_path):
        class Noting(Variant):
            def close(self):
                (tmp_path / str(os.getpid())).touch()

        venv = share_parameters(Noting, 2, n_processes=2)
        workers = {str(proc.pid) for proc in venv.worlds.vec.procs}
        venv.close()
        assert workers <= {path.name for path in tmp_path.iterdir()}

    def test_a_program_that_does_not_close_its_workers_ends(self):
        program = (
            "from conftest import TwoOnALine\n"
            "from sb3_e2c.vec_env import share_parameters\n"
            "venv = share_parameters(TwoOnALine, 2, n_processes=2)\n"
            "venv.reset()\n"
        )
        here = os.path.dirname(__file__)
        subprocess.run([sys.executable, "-c", program], cwd=here, timeout=60, check=True)


LINE = TwoOnALine()
BATCHED_IN_TWO_PROCESSES = {"backend": "batched", "n_processes": 2}


class TestRequests:
    """Each message: what was found, what was expected, what to do."""

    @pytest.mark.parametrize(
        ("error", "message", "make_env", "arguments"),
        [
            (TypeError, "object of type TwoOnALine; expected a function that", TwoOnALine(), {}),
            (TypeError, "convert it with .*aec_to_parallel", lambda: parallel_to_aec(LINE), {}),
            (TypeError, "has one agent, use SB3's make", lambda: gym.make("CartPole-v1"), {}),
            (TypeError, "type NoneType; expected a PettingZoo ParallelEnv", lambda: None, {}),
            (ValueError, "n_worlds is 0; expected at least 1", TwoOnALine, {"n_worlds": 0}),
            (ValueError, "n_processes is 3 for 2 worlds", TwoOnALine, {"n_processes": 3}),
            (ValueError, "n_processes is 0 for 2 worlds", TwoOnALine, {"n_processes": 0}),
            (ValueError, "backend is 'gpu'; expected one of", TwoOnALine, {"backend": "gpu"}),
            (ValueError, "Variant has no method batched", Variant, {"backend": "batched"}),
            (ValueError, "all worlds in one process", TwoOnALine, BATCHED_IN_TWO_PROCESSES),
            (ValueError, "'agent_0' and 'agent_1' have different obs.*pad_obs", Unequal, {}),
            (ValueError, "different action spaces, Discrete.*pad_action", UnequalActions, {}),
        ],
    )
    def test_bad_requests_are_explained(self, error, message, make_env, arguments):
        with pytest.raises(error, match=message):
            share_parameters(make_env, **{"n_worlds": 2, **arguments})

    @pytest.mark.parametrize("n_processes", [1, 2])
    @pytest.mark.parametrize("wrap", [lambda env: env, BaseParallelWrapper])
    def test_the_same_environment_for_two_worlds_is_refused(self, wrap, n_processes):
        env = TwoOnALine()
        with pytest.raises(ValueError, match="returned the same environment twice"):
            share_parameters(lambda: wrap(env), 2, n_processes, backend="supersuit")

    def test_automatic_means_batched_where_the_environment_itself_offers_it(self):
        assert type(share_parameters(TwoOnALine, 2).worlds).__name__ == "BatchedWorlds"
        wrapped = share_parameters(lambda: BaseParallelWrapper(TwoOnALine()), 2)
        assert type(wrapped.worlds).__name__ == "SuperSuitWorlds"


def stock(env, n_worlds=2, n_processes=1):
    """SuperSuit's own adapter to Stable-Baselines3."""
    rows = ss.pettingzoo_env_to_vec_env_v1(env)
    base = "stable_baselines3"
    return ss.concat_vec_envs_v1(rows, n_worlds, num_cpus=n_processes, base_class=base)


class TestWhatSuperSuitsOwnAdapterDoes:
    """Why there is one of our own. A failure here means that SuperSuit has mended a defect.

    The numbers are those of the project's list of defects.
    """

    def test_d1_it_cannot_be_seeded(self):
        with pytest.raises(AttributeError, match="no attribute 'seed'"):
            stock(TwoOnALine()).seed(0)
        with pytest.raises(AttributeError, match="no attribute 'seed'"):
            PPO("MlpPolicy", stock(TwoOnALine()), seed=0, device="cpu")

    def test_d2_all_worlds_are_the_same(self):
        observations = stock(TwoOnALine(spread=10**6)).reset()
        assert same(observations[:2], observations[2:])

    def test_d3_time_limits_are_lost(self):
        venv = stock(TwoOnALine(length=1))
        venv.reset()
        infos = venv.step(np.zeros(4, int))[3]
        assert "TimeLimit.truncated" not in infos[0]

    def test_d4_dones_are_integers_which_vec_normalize_takes_for_indices(self):
        # Rewards 1, 2, 1, 2 with discount 1 and an end after two steps: all returns start again.
        venv = stock(TwoOnALine(length=2))
        with pytest.warns(UserWarning, match="render_mode"):
            normalized = VecNormalize(venv, gamma=1.0)
        ours = VecNormalize(share_parameters(lambda: TwoOnALine(length=2), 2), gamma=1.0)
        for env in (normalized, ours):
            env.reset()
            for _ in range(2):
                dones = env.step(np.tile(SLOW_AND_FAST, 2))[2]
        assert dones.dtype == np.bool_
        assert ours.returns.tolist() == [0, 0, 0, 0]
        # Step 1 sets returns[[0, 0, 0, 0]] to 0, which leaves [0, 2, 1, 2]; with the rewards of
        # step 2 they are [1, 4, 2, 4], and returns[[1, 1, 1, 1]] is set to 0.
        assert normalized.returns.tolist() == [1, 0, 2, 4]

    def test_d5_most_of_the_vec_env_interface_is_missing(self):
        venv = stock(TwoOnALine())
        with pytest.raises(AttributeError):
            venv.get_attr("render_mode")
        with pytest.raises(AttributeError):
            venv.env_method("render")
        with pytest.raises(AttributeError):
            venv.set_options({})
        assert not isinstance(venv.unwrapped, VecEnv)

    def test_d6_infos_of_the_reset_overwrite_those_of_the_last_step(self):
        class CostAtReset(Variant):
            def reset(self, seed=None, options=None):
                return super().reset(seed, options)[0], {a: {"cost": 0.0} for a in AGENTS}

        venv = stock(CostAtReset(length=1))
        venv.reset()
        assert venv.step(np.full(4, FAST))[3][0]["cost"] == 0.0
        mended = share_parameters(lambda: CostAtReset(length=1), 2)
        assert run(mended, 1, actions=[FAST, FAST])[3][0]["cost"] == 1.0
        assert mended.reset_infos[0] == {"cost": 0.0}

    def test_d7_options_and_infos_of_resets_are_dropped(self):
        venv = stock(TwoOnALine(length=2, spread=10**6))
        venv.reset(options={"length": 1})
        assert not venv.step(np.zeros(4, int))[2].any()
        before = [info["start"] for info in venv.reset_infos]
        venv.step(np.zeros(4, int))  # ends the episodes
        assert [info["start"] for info in venv.reset_infos] == before

    def test_d8_worker_processes_lose_infos_and_share_dicts(self):
        venv = stock(TwoOnALine(n_costs=0), n_worlds=2, n_processes=2)
        venv.reset()
        assert len(venv.reset_infos) == 2  # one list for each process, not one dict for each slot
        infos = venv.step(np.zeros(4, int))[3]
        infos[0]["note"] = 1
        assert "note" in infos[3]
        venv.close()

    def test_d12_a_render_mode_has_to_be_there(self):
        with pytest.raises(AttributeError, match="render_mode"):
            stock(SharedInfo())

    def test_d13_an_info_shared_by_agents_has_the_last_agents_observation(self):
        env = SharedInfo(length=1)
        env.render_mode = None
        venv = stock(env)
        venv.reset()
        infos = venv.step(np.tile(SLOW_AND_FAST, 2))[3]
        assert infos[0]["terminal_observation"].tolist() == [3, 1, 1]  # of agent_1; own: [1, 3, 1]

    def test_d14_missing_infos_are_an_error(self):
        venv = stock(Disordered(length=1))
        venv.reset()
        with pytest.raises(KeyError):
            venv.step(np.zeros(4, int))

    def test_d15_pictures_show_one_world(self):
        venv = stock(TwoOnALine(render_mode="rgb_array"))
        venv.reset()
        with pytest.warns(UserWarning, match="render"):
            assert venv.render().shape == (2, 3, 3)
        with pytest.raises(AttributeError):
            venv.get_images()

    def test_d16_environments_have_to_be_picklable(self):
        class HoldsAProcess(Variant):
            def __init__(self):
                super().__init__()
                self.lock = multiprocessing.get_context("spawn").Lock()

        with pytest.raises(RuntimeError, match="inheritance"):
            stock(HoldsAProcess(), n_worlds=1)
        share_parameters(HoldsAProcess, 1).reset()
