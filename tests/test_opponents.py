"""Worlds with a team and opponents: who acts, who learns, and what is left of both in a file."""

import itertools
import pickle
import re
import warnings
from functools import partial
from typing import ClassVar

import numpy as np
import pytest
import torch as th
from conftest import AGENTS, TwoOnALine
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_e2c import (
    E2CMAPPO,
    MAPPO,
    MultiAgentVecEnv,
    OpponentVecEnv,
    TeamEvalCallback,
    TeamMonitor,
    evaluate_team,
    share_parameters,
)
from sb3_e2c.envs import keep_away_v0, physical_deception_v0, predator_prey_v0
from sb3_e2c.opponents import adversary_path

SMALL = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "device": "cpu", "seed": 0}
PARTICLES = [physical_deception_v0, keep_away_v0, predator_prey_v0]
BACKENDS = ["batched", "supersuit"]

each_backend = pytest.mark.parametrize("backend", BACKENDS)
each_policy = pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])


class Guess(ParallelEnv):
    """One agent sees which of three doors is open; choosing it is worth 1, door 2 costs 1.

    It observes the doors (a one for the open one), the number of steps and its last reward.
    """

    possible_agents: ClassVar = ["guesser"]

    def __init__(self, length=4, end="truncated"):
        self.length, self.end, self.rng = length, end, np.random.default_rng()
        self.metadata = {"name": "guess_v0"}

    def observation_space(self, agent):
        return spaces.Box(0.0, np.inf, (5,))

    def action_space(self, agent):
        return spaces.Discrete(3)

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.t, self.earned, self.agents = 0, 0.0, self.possible_agents
        return self._observe(), {"guesser": {"start": -1}}

    def step(self, actions):
        self.earned, cost = float(actions["guesser"] == self.door), float(actions["guesser"] == 2)
        self.t += 1
        over = self.t == self.length
        return (
            self._observe(),
            {"guesser": self.earned},
            {"guesser": over and self.end != "truncated"},
            {"guesser": over and self.end != "terminated"},
            {"guesser": {"cost": cost}},
        )

    def _observe(self):
        self.door = int(self.rng.integers(3))
        doors = [float(self.door == number) for number in range(3)]
        return {"guesser": np.array([*doors, self.t, self.earned], np.float32)}


class SideBySide(ParallelEnv):
    """A line with two agents, and a guesser between them; neither game knows of the other.

    :param team: "line" or "guess", the other game's agents are the opponents
    :param settings: of both games
    """

    possible_agents: ClassVar = [AGENTS[0], "guesser", AGENTS[1]]

    def __init__(self, team="line", length=4, end="truncated", spread=1, n_costs=1):
        self.settings = {k: v for k, v in locals().items() if k in ("length", "end")}
        line = TwoOnALine(**self.settings, spread=spread, n_costs=n_costs)
        self.games = {"line": line, "guess": Guess(**self.settings)}
        self.metadata = {"name": "side_by_side_v0", "team": self.games[team].possible_agents}
        self.team, self.agents = team, []
        self.render_mode = None

    def batched_groups(self, n_worlds):
        names = [name for name in ("line", "guess") if name != self.team]
        groups = (self.metadata["team"], self.games[names[0]].possible_agents)
        spread, n_costs = self.games["line"].spread, self.games["line"].n_costs
        make = partial(SideBySide, self.team, **self.settings, spread=spread, n_costs=n_costs)
        return Grouped([make() for _ in range(n_worlds)], *groups)

    def observation_space(self, agent):
        return self.game(agent).observation_space(agent)

    def action_space(self, agent):
        return self.game(agent).action_space(agent)

    def game(self, agent):
        return self.games["line" if agent in AGENTS else "guess"]

    def reset(self, seed=None, options=None):
        self.agents = self.possible_agents
        return merged([game.reset(seed, options) for game in self.games.values()])

    def step(self, actions):
        for agent, action in actions.items():
            assert self.action_space(agent).contains(action), f"{agent}: {action}"
        return merged([game.step(actions) for game in self.games.values()])


class Grouped:
    """Environments in a loop, with what belongs to agents as arrays by group."""

    def __init__(self, envs, team, opponents):
        self.envs, self.groups = envs, {"team": team, "opponents": opponents}
        self.n_worlds, self.render_mode, self.metadata = len(envs), None, envs[0].metadata
        self.observation_space = envs[0].observation_space
        self.action_space = envs[0].action_space

    def reset(self, worlds, seeds, options=None):
        parts = [self.envs[w].reset(s, options) for w, s in zip(worlds, seeds, strict=True)]
        return self.stack([obs for obs, _ in parts]), self.columns([infos for _, infos in parts])

    def step(self, actions):
        parts = [
            env.step(
                {
                    a: actions[g][w, i]
                    for g, names in self.groups.items()
                    for i, a in enumerate(names)
                }
            )
            for w, env in enumerate(self.envs)
        ]
        obs, rewards, terminated, truncated, infos = zip(*parts, strict=True)
        ends = (np.array([ends[AGENTS[0]] for ends in each]) for each in (terminated, truncated))
        return self.stack(obs), self.stack(rewards), *ends, self.columns(infos)

    def stack(self, dicts):
        return {
            group: np.array([[each[agent] for agent in names] for each in dicts], np.float32)
            for group, names in self.groups.items()
        }

    def columns(self, infos):
        return {
            group: {
                key: np.array([[info[agent][key] for agent in names] for info in infos])
                for key in infos[0][names[0]]
            }
            for group, names in self.groups.items()
        }

    def close(self):
        pass


def merged(answers):
    """The dicts of two games as one."""
    return tuple({**line, **guess} for line, guess in zip(*answers, strict=True))


def games(n_worlds=2, seed=0, backend="auto", n_processes=1, **parameters):
    make_env = partial(SideBySide, **parameters)
    return share_parameters(make_env, n_worlds, n_processes, seed=seed, backend=backend)


def prey(n_worlds=2, seed=0, max_cycles=4, **kwargs):
    make_env = partial(predator_prey_v0.parallel_env, max_cycles=max_cycles)
    return share_parameters(make_env, n_worlds, seed=seed, **kwargs)


def make(env=None, algorithm=MAPPO, policy="MlpPolicy", **kwargs):
    memory = {"gru_hidden_size": 8} if policy == "GruPolicy" else {}
    settings = {**SMALL, "policy_kwargs": {"net_arch": [16], **memory}, **kwargs}
    return algorithm(policy, env or games(), **settings)


def flat(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def same_weights(first, second):
    return th.equal(flat(first), flat(second))


def choose_always(model, action):
    """Bias the policy so far that every agent always chooses one action."""
    with th.no_grad():
        model.policy.action_net.bias.fill_(-100.0)[action] = 100.0
    return model


def collect(model):
    """One rollout, without learning from it."""
    _, callback = model._setup_learn(10**6)
    callback.on_training_start({}, {})
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)


def assert_same(left, right, rtol=0.0):
    """Equal through lists, dicts and arrays; exactly, unless a relative tolerance is given."""
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key], rtol)
    elif isinstance(left, (list, tuple)):
        assert len(left) == len(right)
        for one, other in zip(left, right, strict=True):
            assert_same(one, other, rtol)
    else:
        np.testing.assert_allclose(left, right, rtol=rtol, atol=rtol)


class Recorded(BaseCallback):
    """Keeps the last value of every logger key."""

    def _on_training_start(self):
        self.values = {}
        record = self.model.logger.record

        def spy(key, value, exclude=None):
            self.values[key] = value
            record(key, value, exclude)

        self.model.logger.record = spy

    def _on_step(self):
        return True


class Scripted:
    """An opponent that plays 0, 1, 2, 0, ... from the beginning of each of its episodes."""

    def __init__(self):
        self.calls = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        steps = np.zeros(len(observation), int) if state is None else state[0]
        steps = np.where(episode_start, 0, steps)
        self.calls.append((observation, steps, deterministic))
        return steps % 3, (steps + 1,)


class OwnRandomness:
    """Lets methods of a model draw from random streams that nobody else uses."""

    def __init__(self, model, seed=5):
        self.torch = th.Generator().manual_seed(seed).get_state()
        self.numpy = np.random.RandomState(seed).get_state()
        self.start_episodes = model.start_episodes
        model.start_episodes, model.train = self.start, self.wrapped(model.train)

    def start(self, *args):
        collector = self.start_episodes(*args)
        collector.act = self.wrapped(collector.act)
        return collector

    def wrapped(self, method):
        def call():
            outside = th.get_rng_state(), np.random.get_state()
            self.set(self.torch, self.numpy)
            result = method()
            self.torch, self.numpy = th.get_rng_state(), np.random.get_state()
            self.set(*outside)
            return result

        return call

    @staticmethod
    def set(torch_state, numpy_state):
        th.set_rng_state(torch_state)
        np.random.set_state(numpy_state)


class TestSides:
    def test_slots_are_the_teams_and_spaces_are_native_on_both_sides(self):
        env = prey(n_worlds=3)
        assert isinstance(env, OpponentVecEnv)
        assert env.agents == ["adversary_0", "adversary_1", "adversary_2"]
        assert (env.num_envs, env.n_agents) == (9, 3)
        assert env.observation_space.shape == (16,)
        assert env.opponents.agents == ["agent_0"]
        assert env.opponents.observation_space.shape == (14,)
        env.set_opponent("random")
        assert env.reset().shape == (9, 16)

    @each_backend
    def test_every_agent_gets_its_own_row_also_where_the_sides_alternate(self, backend):
        env = games(n_worlds=2, backend=backend, team="line")
        script = Scripted()
        env.set_opponent(script)
        # own position, the other's position, time
        assert env.reset().tolist() == [[0, 1, 0], [1, 0, 0]] * 2
        observations, rewards, *_ = env.step(np.array([0, 1, 1, 0]))
        assert observations.tolist() == [[1, 3, 1], [3, 1, 1], [2, 2, 1], [2, 2, 1]]
        assert rewards.tolist() == [1, 2, 2, 1]
        env.step(np.zeros(4, int))
        assert [obs.shape for obs, _, _ in script.calls] == [(2, 5)] * 2
        doors = [np.random.default_rng(world).integers(3) for world in range(2)]
        first, second = (obs for obs, _, _ in script.calls)
        assert first[:, :3].argmax(axis=1).tolist() == doors
        assert second[:, 3].tolist() == [1, 1]
        assert second[:, 4].tolist() == [float(door == 0) for door in doors]  # it chose door 0

    @each_backend
    def test_no_network_has_an_input_for_padding(self, backend):
        model = make(games(backend=backend, team="line"))  # 3 numbers for the team, 5 beside it
        assert model.policy.mlp_extractor.policy_net[0].in_features == 3
        assert model.policy.mlp_extractor.value_net[0].in_features == 2 * 3
        assert model.policy.action_net.out_features == 2
        opponent = model.opponent.policy
        assert opponent.mlp_extractor.policy_net[0].in_features == 5
        assert opponent.action_net.out_features == 3
        model.learn(64)
        assert model.rollout_buffer.observations.shape == (8, 4, 3)
        assert model.opponent.rollout_buffer.observations.shape == (8, 2, 5)

    @pytest.mark.parametrize("team", ["line", "guess"])
    @pytest.mark.parametrize("way", [{"backend": "supersuit"}, {"n_processes": 2}], ids=str)
    def test_all_ways_give_the_same_bit_for_bit(self, team, way):
        parameters = {"n_worlds": 3, "seed": 4, "team": team, "length": 3, "spread": 100}
        envs = [games(**parameters), games(**parameters, **way)]
        for env in envs:
            env.set_opponent("random")
        first = [env.reset() for env in envs]
        assert_same(*first)
        assert_same(*[env.reset_infos for env in envs])
        rng = np.random.default_rng(0)
        for _ in range(7):
            actions = rng.integers(envs[0].action_space.n, size=envs[0].num_envs)
            assert_same(*[env.step(actions) for env in envs])
            assert_same(*[env.reset_infos for env in envs])
        for env in envs:
            env.close()

    @pytest.mark.parametrize("module", PARTICLES, ids=lambda module: module.__name__[12:-3])
    @pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
    def test_particle_tasks_are_the_same_in_the_simulator_and_through_supersuit(
        self, module, continuous
    ):
        make_env = partial(module.parallel_env, max_cycles=5, continuous_actions=continuous)
        envs = [share_parameters(make_env, 2, seed=3, backend=backend) for backend in BACKENDS]
        for env in envs:
            env.set_opponent("random")
        assert_same(*[env.reset() for env in envs], rtol=1e-5)
        rng = np.random.default_rng(0)
        for step in range(1, 13):
            actions = rng.uniform(0, 1, (6, 5)) if continuous else rng.integers(5, size=6)
            outcomes = [env.step(actions) for env in envs]
            assert_same(*outcomes, rtol=1e-5)
            assert_same(*[env.reset_infos for env in envs])
            assert outcomes[0][2].all() == (step % 5 == 0)
        keys = {"cost", "terminal_observation", "TimeLimit.truncated"}
        assert {key for _ in range(4) for key in envs[0].step(actions)[3][0]} <= keys

    def test_continuous_actions_of_different_sizes_arrive_whole_on_both_sides(self):
        env = share_parameters(Wide, 2, team=["wide"])
        env.set_opponent("random")
        env.reset()
        actions = np.array([[0.5, -0.5, 0.25], [1.0, 0.0, -1.0]], np.float32)
        _, _, _, infos = env.step(actions)
        assert [info["action"].tolist() for info in infos] == actions.tolist()
        narrow = [world.unwrapped.actions["narrow"] for world in env.worlds.sides.rows.envs]
        expected = Wide().action_space("narrow")
        assert [row.shape for row in narrow] == [expected.shape] * 2
        assert all(expected.contains(row) for row in narrow)
        assert narrow[0].tolist() != narrow[1].tolist()

    @each_backend
    def test_options_of_a_reset_reach_the_worlds(self, backend):
        env = games(backend=backend)
        env.set_opponent("random")
        env.set_options({"start": 5})
        assert env.reset()[:, 0].tolist() == [5, 6, 5, 6]
        env.set_options([{"start": 1}] * 2 + [{"start": 2}] * 2)
        assert env.reset()[:, 0].tolist() == [1, 2, 2, 3]
        assert [info["start"] for info in env.reset_infos] == [1, 1, 2, 2]

    def test_infos_at_the_end_belong_to_the_team(self):
        for backend in BACKENDS:
            env = games(backend=backend, length=2)
            env.set_opponent(Scripted())
            env.reset()
            env.step(np.ones(4, int))
            _, _, dones, infos = env.step(np.ones(4, int))
            assert dones.all()
            last = [info["terminal_observation"].tolist() for info in infos]
            assert last == [[4, 5, 2], [5, 4, 2]] * 2
            assert [info["TimeLimit.truncated"] for info in infos] == [True] * 4

    def test_all_agents_as_the_team_is_a_world_without_opponents(self):
        env = share_parameters(TwoOnALine, 2, team=["agent_1", "agent_0"])
        assert type(env) is MultiAgentVecEnv
        assert env.agents == AGENTS

    def test_team_overrules_what_the_environment_declares(self):
        env = share_parameters(SideBySide, 2, team=["guesser"])
        assert (env.agents, env.opponents.agents) == (["guesser"], AGENTS)

    @pytest.mark.parametrize("team", [["agent_7"], ["agent_0", "x"], [], "agent_0"])
    def test_a_team_of_unknown_agents_is_refused(self, team):
        message = f"team is {team!r}; expected a list of some of the agents {AGENTS}"
        with pytest.raises(ValueError, match=re.escape(message)):
            share_parameters(TwoOnALine, team=team)

    def test_agents_of_one_side_with_different_spaces_are_refused(self):
        with pytest.raises(ValueError, match="'agent_0' and 'guesser' have different observation"):
            share_parameters(SideBySide, team=["agent_0", "guesser"])

    def test_spaces_that_no_padding_makes_equal_are_refused(self):
        with pytest.raises(ValueError, match=r"action spaces .* Discrete\(2\).* Wrap"):
            share_parameters(Mixed, team=["left"])

    def test_sides_with_several_arrays_in_an_observation_are_refused(self):
        with pytest.raises(ValueError, match=r"observation spaces .*not Dict, not Tuple.* flatten"):
            share_parameters(Labelled, team=["wide"])

    def test_the_simulator_is_not_used_for_another_team_than_its_own(self):
        message = "SideBySide has no method batched_groups(n_worlds) for the team ['guesser']"
        with pytest.raises(ValueError, match=re.escape(message)):
            share_parameters(SideBySide, backend="batched", team=["guesser"])


class Wide(ParallelEnv):
    """One agent with three numbers to choose and one with two; infos tell what arrived."""

    metadata: ClassVar = {"name": "wide_v0"}
    possible_agents: ClassVar = ["narrow", "wide"]
    render_mode = None

    def observation_space(self, agent):
        return spaces.Box(-1.0, 1.0, (2 if agent == "wide" else 1,))

    def action_space(self, agent):
        return spaces.Box(-1.0, 1.0, (3 if agent == "wide" else 2,))

    def reset(self, seed=None, options=None):
        self.agents = self.possible_agents
        return self.observe(), {agent: {} for agent in self.agents}

    def step(self, actions):
        self.actions = actions
        ends = dict.fromkeys(self.agents, False)
        infos = {agent: {"action": action} for agent, action in actions.items()}
        return self.observe(), dict.fromkeys(self.agents, 0.0), ends, ends, infos

    def observe(self):
        return {agent: np.zeros(self.observation_space(agent).shape) for agent in self.agents}


class Mixed(Wide):
    """One agent chooses a number, the other one of two actions."""

    possible_agents: ClassVar = ["left", "right"]

    def action_space(self, agent):
        return spaces.Discrete(2) if agent == "left" else spaces.Box(-1.0, 1.0, (2,))


class Labelled(Wide):
    """Observations are dicts."""

    def observation_space(self, agent):
        return spaces.Dict({"numbers": spaces.Box(-1.0, 1.0, (2,))})

    def observe(self):
        return {agent: {"numbers": np.zeros(2, np.float32)} for agent in self.agents}


class TestWhoActs:
    def test_a_step_with_nobody_chosen_says_what_to_do(self):
        env = games()
        env.reset()
        with pytest.raises(RuntimeError, match=r"nobody acts for .*guesser.*set_opponent"):
            env.step(np.zeros(4, int))

    @pytest.mark.parametrize("opponent", ["strong", "model.zip"])
    def test_an_unknown_word_is_refused(self, opponent):
        with pytest.raises(ValueError, match=f"opponent is '{opponent}'; expected 'random' or"):
            games().set_opponent(opponent)

    def test_what_cannot_act_is_refused(self):
        with pytest.raises(TypeError, match="opponent is None; expected 'random' or a model"):
            games().set_opponent(None)

    def test_a_model_of_other_spaces_is_refused(self):
        team = make()
        with pytest.raises(ValueError, match=r"observation_space of the opponents' model is Box"):
            games().set_opponent(team)

    def test_who_cannot_learn_is_refused_at_once(self):
        env = games()
        with pytest.raises(ValueError, match="'random'; expected a model that learns"):
            env.set_opponent("random", learning=True)
        with pytest.raises(TypeError, match="type Scripted cannot learn beside the team"):
            env.set_opponent(Scripted(), learning=True)
        with pytest.raises(ValueError, match=r"is Box.* use a model that was trained as their"):
            env.set_opponent(make(games()), learning=True)
        with pytest.raises(ValueError, match=r"2 slots of \['guesser'\], but here are 3 of"):
            games(n_worlds=3).set_opponent(make(games()).opponent, learning=True)
        assert env.opponent is None

    @each_backend
    def test_random_opponents_are_the_seeds_and_only_the_seeds(self, backend):
        def played(seed, noise):
            env = games(n_worlds=4, seed=seed, backend=backend, team="guess", spread=9)
            env.set_opponent("random")
            env.reset()
            np.random.seed(noise)
            th.manual_seed(noise)
            rows = []
            for _ in range(6):
                env.step(np.zeros(4, int))
                rows.append(env.worlds._observations.copy())
            return np.array(rows)

        np.testing.assert_array_equal(played(1, noise=0), played(1, noise=1))
        assert (played(1, noise=0) != played(2, noise=0)).any()

    def test_random_opponents_chosen_within_an_episode_repeat_too(self):
        drawn = []
        for _ in range(2):
            env = games(n_worlds=10)
            env.reset()
            env.set_opponent("random")
            drawn.append(env.worlds.opponents.act().tolist())
        assert drawn[0] == drawn[1]

    def test_random_opponents_do_not_repeat_the_draws_of_their_world(self):
        env = games(n_worlds=20, seed=3)
        env.set_opponent("random")
        env.reset()
        numbers = np.random.default_rng(3).random(20)  # what a world with this seed draws
        assert env.worlds.opponents.act().tolist() != (3 * numbers).astype(int).tolist()

    @each_backend
    def test_a_recurrent_opponent_forgets_at_the_beginning_of_each_of_its_episodes(self, backend):
        env = games(backend=backend)
        script = Scripted()
        env.set_opponent(script)
        env.reset()
        for _ in range(6):
            env.step(np.zeros(4, int))
        assert [steps.tolist() for _, steps, _ in script.calls] == [
            *([0, 0], [1, 1], [2, 2], [3, 3]),
            *([0, 0], [1, 1]),
        ]
        env.reset()
        env.step(np.zeros(4, int))
        assert script.calls[-1][1].tolist() == [0, 0]

    def test_who_acts_may_change_within_an_episode(self):
        env = games(team="guess")
        slow, fast = Scripted(), Scripted()
        slow.predict = lambda obs, *_: (np.zeros(len(obs), int), None)
        fast.predict = lambda obs, *_: (np.ones(len(obs), int), None)
        env.set_opponent(slow)
        env.reset()
        env.step(np.zeros(2, int))
        env.set_opponent(fast)
        env.step(np.zeros(2, int))
        # own position, the other's, time: one slow step, one fast one
        assert env.worlds._observations.tolist() == [[3, 4, 2], [4, 3, 2]] * 2
        assert env.opponent is fast

    def test_a_trained_opponent_samples_unless_told_otherwise(self):
        env, script = games(), Scripted()
        for deterministic in (False, True):
            env.set_opponent(script, deterministic=deterministic)
            env.reset()
            env.step(np.zeros(4, int))
            assert script.calls[-1][2] is deterministic
        env.set_opponent(script)
        env.step(np.zeros(4, int))
        assert script.calls[-1][2] is False

    def test_any_model_of_stable_baselines3_may_be_the_opponent(self):
        alone = share_parameters(Guess, 2)
        env = games()
        env.set_opponent(PPO("MlpPolicy", alone, n_steps=4, batch_size=8, device="cpu"))
        model = make(env)
        assert model.opponent is None
        model.learn(64)

    def test_plain_ppo_trains_the_team_against_a_fixed_opponent(self):
        env, opponent = prey(), make(prey()).opponent
        before = flat(opponent).clone()
        env.set_opponent(opponent)
        model = PPO("MlpPolicy", env, n_steps=8, batch_size=16, n_epochs=1, device="cpu")
        start = flat(model).clone()
        model.learn(96)
        assert model.policy.mlp_extractor.policy_net[0].in_features == 16
        assert not th.equal(flat(model), start)
        assert th.equal(flat(opponent), before)

    def test_a_learner_also_acts_for_whom_nobody_collects(self):
        env = games()
        opponent, seen = make(env).opponent, []
        act = opponent.policy.act
        opponent.policy.act = lambda obs, states: (seen.append(obs.numpy()), act(obs, states))[1]
        before = flat(opponent).clone()
        PPO("MlpPolicy", env, n_steps=8, batch_size=16, n_epochs=1, device="cpu").learn(32)
        assert np.array(seen)[:, 0, 3].tolist() == [0, 1, 2, 3] * 2  # the step of the episode
        assert th.equal(flat(opponent), before)

    def test_plain_ppo_with_nobody_chosen_says_what_to_do(self):
        model = PPO("MlpPolicy", games(), n_steps=8, batch_size=16, device="cpu")
        with pytest.raises(RuntimeError, match="set_opponent"):
            model.learn(64)


class TestWrappers:
    def test_a_monitor_counts_the_team_only(self):
        env = TeamMonitor(games(length=2))
        env.set_opponent(Scripted())  # through the wrapper
        env.reset()
        env.step(np.ones(4, int))
        _, _, _, infos = env.step(np.ones(4, int))
        # two agents, two fast steps each: reward 2 and cost 1 for every one
        assert [infos[slot]["episode"][key] for slot in (0, 2) for key in ("r", "l", "cost")] == [
            *(8, 2, 4),
            *(8, 2, 4),
        ]

    def test_observations_are_normalized_for_the_team_only(self):
        flat_env, script = games(), Scripted()
        env = VecNormalize(flat_env, gamma=0.9)
        flat_env.set_opponent(script)
        env.reset()
        for _ in range(5):
            observations, *_ = env.step(np.ones(4, int))
        assert env.obs_rms.mean.shape == (3,)
        assert observations.shape == (4, 3)
        seen = np.concatenate([obs for obs, _, _ in script.calls])
        assert set(seen[:, :3].ravel()) == {0.0, 1.0}  # doors as they are
        assert seen[:, 3].max() == 3

    def test_a_normalized_team_trains_beside_its_opponents(self):
        model = make(VecNormalize(games(), gamma=0.9))
        model.learn(64)
        assert model.opponent._n_updates == 2 * 2
        assert model.opponent.rollout_buffer.observations[..., :3].max() == 1.0

    def test_worlds_pickle_within_an_episode_and_go_on_exactly(self):
        env = prey(n_worlds=3)
        model = make(env, policy="GruPolicy")
        model.learn(2 * 3 * 3 * 8)
        copy = pickle.loads(pickle.dumps(env))
        assert copy.opponent is copy.learner.model is not model.opponent
        for _ in range(6):
            actions, outcomes = np.random.default_rng(0).integers(5, size=9), []
            for each in (env, copy):
                th.manual_seed(1)
                outcomes.append(each.step(actions))
            assert_same(*outcomes)

    def test_worlds_pickle_also_while_the_team_writes_a_log(self, tmp_path):
        model = make()
        logger = configure(str(tmp_path), ["csv"])
        model.set_logger(logger)
        model.learn(64)
        copy = pickle.loads(pickle.dumps(model.env.unwrapped.opponent))
        logger.close()
        assert same_weights(copy, model.opponent)


class TestLearning:
    def test_opponents_get_a_model_of_their_own(self):
        env = games(team="guess")
        model = make(env, cost_limits=1.0, opponent_kwargs={"gamma": 0.5}, algorithm=E2CMAPPO)
        opponent = model.opponent
        assert type(opponent) is MAPPO
        assert env.opponent is opponent is env.learner.model
        assert (opponent.agents, opponent.n_envs) == (AGENTS, 4)
        assert (opponent.gamma, opponent.n_steps, opponent.n_epochs) == (0.5, 8, 2)
        assert len(opponent.cost_limits) == 0
        assert model.gamma == 0.99

    def test_the_teams_first_parameters_do_not_depend_on_who_acts_for_the_others(self):
        env = games()
        env.set_opponent("random")
        assert same_weights(make(), make(env))

    @each_policy
    def test_nobody_changes_within_a_rollout_and_both_do_once_between_two(self, policy):
        model = make(policy=policy)
        seen = []

        class Watch(BaseCallback):
            def _on_step(self):
                seen.append((flat(model).clone(), flat(model.opponent).clone()))
                assert model._n_updates == model.opponent._n_updates == 2 * ((len(seen) - 1) // 8)
                return True

        model.learn(3 * 32, callback=Watch())
        assert len(seen) == 24
        for before, after in itertools.pairwise(seen):
            between = after is seen[8] or after is seen[16]
            assert [not th.equal(a, b) for a, b in zip(before, after, strict=True)] == [between] * 2
        assert model._n_updates == model.opponent._n_updates == 2 * 3
        assert model.opponent.num_timesteps == 3 * 8 * 2  # steps of two guessers

    @each_policy
    @pytest.mark.parametrize("backend", BACKENDS)
    @pytest.mark.parametrize("side", ["team", "opponents"])
    def test_either_side_learns_bit_for_bit_like_a_team_alone_in_its_own_game(
        self, side, backend, policy
    ):
        # episodes of 3 steps in rollouts of 8, so that they go on from one rollout to the next
        alone_env = share_parameters(partial(TwoOnALine, length=3, spread=10), 2)
        both_env = games(2, length=3, spread=10, team="line" if side == "team" else "guess")
        settings = {
            "policy": policy,
            "learning_rate": lambda progress: 1e-2 * progress,
            "reward_scale": 0.5,
            "normalize_values": True,
            "ent_coef": 0.01,
            "target_kl": 0.05,
        }
        alone, team = make(alone_env, **settings), make(both_env, **settings)
        compared = team if side == "team" else team.opponent
        compared.policy.load_state_dict(alone.policy.state_dict())
        for model in (alone, compared):
            OwnRandomness(model)
        start = flat(alone).clone()
        alone.learn(4 * 8 * 4)
        team.learn(4 * 8 * 2 * team.n_agents)
        assert alone._n_updates == compared._n_updates > 0
        assert not th.equal(flat(alone), start)
        assert same_weights(alone, compared)
        assert th.equal(alone.policy.value_norm.mean, compared.policy.value_norm.mean)

    def test_the_comparison_with_a_team_alone_can_fail(self):
        alone = make(share_parameters(TwoOnALine, 2))
        team = make(games(team="guess"), opponent_kwargs={"gae_lambda": 0.5})
        team.opponent.policy.load_state_dict(alone.policy.state_dict())
        for model in (alone, team.opponent):
            OwnRandomness(model)
        alone.learn(32)
        team.learn(16)
        assert not same_weights(alone, team.opponent)

    def test_opponents_become_good_at_their_own_game(self):
        model = make(n_steps=64, batch_size=128, n_epochs=5, learning_rate=1e-2)
        recorded = Recorded()
        model.learn(10 * 64 * 4, callback=recorded)
        # by chance it finds a third of the doors: 4/3 in an episode of 4 steps
        assert recorded.values["adversary/rollout/ep_rew_mean"] > 3

    @each_policy
    @each_backend
    def test_the_same_seed_twice_gives_the_same_parameters_of_both(self, policy, backend):
        models = [make(games(backend=backend, seed=3), policy=policy).learn(96) for _ in range(2)]
        assert same_weights(*models)
        assert same_weights(*[model.opponent for model in models])
        other = make(games(backend=backend, seed=3), policy=policy, seed=1).learn(96)
        assert not same_weights(other.opponent, models[0].opponent)

    @pytest.mark.parametrize("deterministic", [False, True])
    def test_evaluations_in_between_change_nothing(self, deterministic):
        undisturbed = make(policy="GruPolicy").learn(96)
        eval_env = games(seed=100)
        callback = TeamEvalCallback(
            eval_env, eval_freq=3, n_eval_episodes=3, deterministic=deterministic, verbose=0
        )
        model = make(policy="GruPolicy").learn(96, callback=callback)
        assert callback.n_calls == 24
        assert eval_env.opponent is model.opponent
        assert eval_env.learner is None
        assert same_weights(model, undisturbed)
        assert same_weights(model.opponent, undisturbed.opponent)

    def test_an_evaluation_keeps_the_opponent_that_was_chosen_for_it(self):
        eval_env, script = games(seed=100), Scripted()
        eval_env.set_opponent(script)
        model = make()
        model.learn(32, callback=TeamEvalCallback(eval_env, eval_freq=8, n_eval_episodes=1))
        assert eval_env.opponent is script
        assert len(script.calls) == 4

    def test_the_opponents_of_an_evaluation_sample_or_take_the_likeliest_actions(self):
        model, env = make(games(team="guess")), games(team="guess")
        actor = model.opponent.policy.action_net
        with th.no_grad():  # slow with probability 3/4
            actor.weight.zero_()
            actor.bias.copy_(th.tensor([np.log(3.0), 0.0]))
        for deterministic, possible in ((True, {0}), (False, {0, 1})):
            env.set_opponent(model.opponent, deterministic=deterministic)
            env.reset()
            taken = {int(action) for _ in range(20) for action in env.worlds.opponents.act()}
            assert taken == possible
            assert len(evaluate_team(model, env, n_episodes=2).returns) == 2

    def test_time_limits_of_opponents_are_bootstrapped_from_their_own_last_observation(self):
        model = make(games(team="guess"), gamma=0.5)
        choose_always(model.opponent, 1)
        with th.no_grad():
            model.opponent.policy.value_net.bias.fill_(10.0)
        collect(model)
        opponent = model.opponent
        buffer = opponent.rollout_buffer
        # two fast agents: 0 and 1 at first, 8 and 9 after four steps
        last = [[8.0, 9.0, 4.0], [9.0, 8.0, 4.0]] * 2
        assert [timeout.step for timeout in buffer.timeouts] == [3, 7]
        for timeout in buffer.timeouts:
            assert timeout.observations.tolist() == last
        teams = th.tensor(last).reshape(2, 2, 3)
        with th.no_grad():
            values, _ = opponent.policy.team_values(teams, th.zeros(2, 0))
        rewards = np.full((8, 4), 2.0)
        rewards[[3, 7]] += 0.5 * values.numpy().ravel()
        np.testing.assert_allclose(buffer.rewards, rewards, rtol=1e-6)
        assert (buffer.rewards[3] > 5).all()

    def test_a_true_end_of_opponents_is_not_bootstrapped(self):
        model = make(games(team="guess", end="terminated"))
        collect(model)
        assert model.opponent.rollout_buffer.timeouts == []
        assert model.opponent.rollout_buffer.rewards.max() <= 2.0
        assert model.opponent.rollout_buffer.dones[3].all()

    def test_the_log_has_the_opponents_beside_the_team(self):
        recorded, without = Recorded(), Recorded()
        model = make(games(team="guess"), learning_rate=0.0, cost_limits=5.0)
        choose_always(model.opponent, 1)
        model.learn(48, callback=recorded)
        env = games(team="guess")
        env.set_opponent("random")
        make(env, learning_rate=0.0, cost_limits=5.0).learn(48, callback=without)
        ours = {key for key in recorded.values if key.startswith("adversary/")}
        assert recorded.values.keys() - ours == without.values.keys()
        assert {"adversary/train/loss", "adversary/train/learning_rate"} < ours
        assert "adversary/train/cost_value_loss" not in ours
        # two agents, four fast steps of 2 each
        assert recorded.values["adversary/rollout/ep_rew_mean"] == 2 * 4 * 2
        assert recorded.values["adversary/train/n_updates"] == 2 * 3
        assert recorded.values["rollout/ep_rew_mean"] <= 4
        for key in ("rollout/ep_len_mean", "time/env_steps"):
            assert recorded.values[key] == without.values[key]

    def test_the_opponents_reward_scale_stays_out_of_the_log(self):
        model = make(games(team="guess"), reward_scale=10.0)
        choose_always(model.opponent, 0)
        recorded = Recorded()
        model.learn(16, callback=recorded)
        assert recorded.values["adversary/rollout/ep_rew_mean"] == 2 * 4
        assert (model.opponent.rollout_buffer.rewards[0] == 10.0).all()

    @pytest.mark.parametrize("name", ["cost_limits", "n_steps", "n_stepz", "env"])
    def test_arguments_that_opponents_cannot_have_are_refused(self, name):
        with pytest.raises(ValueError, match=rf"opponent_kwargs has \['{name}'\]; expected only"):
            make(opponent_kwargs={name: 4})

    def test_each_side_may_have_its_own_kind_of_network(self):
        own = {"policy": "GruPolicy", "learning_rate": 1e-4, "policy_kwargs": {"net_arch": [4]}}
        model = make(opponent_kwargs=own)
        model.learn(64)
        assert (model.policy.recurrent, model.opponent.policy.recurrent) == (False, True)
        assert model.opponent.policy.mlp_extractor.policy_net[0].out_features == 4
        assert model.opponent._n_updates == 4

    def test_a_chosen_opponent_does_not_learn(self):
        model, env = make(), games()
        env.set_opponent(model.opponent)
        before = flat(model.opponent).clone()
        other = make(env).learn(64)
        assert other.opponent is None
        assert th.equal(flat(model.opponent), before)

    def test_another_environment_gets_the_same_model_of_opponents(self):
        model = make().learn(32)
        opponent, before = model.opponent, flat(model.opponent).clone()
        env = games(seed=7)
        model.set_env(env)
        assert env.learner.model is opponent
        model.learn(32, reset_num_timesteps=False)
        assert not th.equal(flat(opponent), before)

    def test_learning_stopped_by_a_callback_can_go_on(self):
        class Stop(BaseCallback):
            def _on_step(self):
                return self.n_calls < 5

        model = make(policy="GruPolicy")
        model.learn(64, callback=Stop())
        assert (model._n_updates, model.opponent._n_updates) == (0, 0)
        model.learn(32, reset_num_timesteps=False)
        assert (model._n_updates, model.opponent._n_updates) == (2, 2)
        # five steps were made before, in episodes of four
        steps = model.opponent.rollout_buffer.observations[:, 0, 3]
        assert steps.tolist() == [1, 2, 3, 0, 1, 2, 3, 0]

    def test_numbers_of_opponents_that_are_not_finite_stop_the_run(self):
        model = make()
        game = model.env.unwrapped.worlds.sides.sim.envs[1].games["guess"]
        step = game.step
        game.step = lambda actions: (*step(actions)[:1], {"guesser": np.nan}, *step(actions)[2:])
        with pytest.raises(ValueError, match="reward of world 1, agent 'guesser' is not finite"):
            model.learn(32)


class TestFiles:
    @pytest.mark.parametrize(
        ("team", "adversary"),
        [
            ("a/team", "a/team.adversary.zip"),
            ("a/team.zip", "a/team.adversary.zip"),
            ("a/run.1_steps.zip", "a/run.1_steps.adversary.zip"),
        ],
    )
    def test_the_adversary_lies_beside_its_team(self, team, adversary):
        assert adversary_path(team).as_posix() == adversary

    @each_policy
    @pytest.mark.parametrize("name", ["team", "team.zip"])
    def test_both_sides_come_back_and_go_on_learning(self, tmp_path, policy, name):
        model = make(policy=policy).learn(64)
        model.save(tmp_path / name)
        assert {path.name for path in tmp_path.iterdir()} == {"team.zip", "team.adversary.zip"}
        loaded = MAPPO.load(tmp_path / name, env=games(), device="cpu")
        assert same_weights(loaded, model)
        assert same_weights(loaded.opponent, model.opponent)
        observation = np.eye(5, dtype=np.float32)
        both = (model.opponent, loaded.opponent)
        assert_same(*[each.predict(observation, deterministic=True)[0] for each in both])
        optimizers = [each.policy.optimizer.state_dict()["state"] for each in both]
        for key in optimizers[0]:
            assert th.equal(optimizers[0][key]["exp_avg"], optimizers[1][key]["exp_avg"])
        before = flat(loaded.opponent).clone()
        loaded.learn(32, reset_num_timesteps=False)
        assert not th.equal(flat(loaded.opponent), before)

    def test_a_loaded_team_may_have_more_worlds(self, tmp_path):
        model = make().learn(64)
        model.save(tmp_path / "team")
        loaded = MAPPO.load(tmp_path / "team", env=games(n_worlds=3), device="cpu")
        assert loaded.opponent.n_envs == 3
        assert same_weights(loaded.opponent, model.opponent)
        loaded.learn(48)

    def test_the_teams_file_holds_no_opponent(self, tmp_path):
        make().learn(32).save(tmp_path / "team")
        adversary_path(tmp_path / "team").unlink()
        loaded = MAPPO.load(tmp_path / "team", device="cpu")  # only to predict
        assert loaded.opponent is None
        assert loaded.predict(np.zeros((2, 3), np.float32))[0].shape == (2,)

    def test_loading_without_the_adversary_says_that_the_task_is_another_one(self, tmp_path):
        make().save(tmp_path / "team")
        beside = adversary_path(tmp_path / "team")
        beside.unlink()
        with pytest.raises(FileNotFoundError, match=re.escape(f"{beside}. Without it the task")):
            MAPPO.load(tmp_path / "team", env=games())

    @pytest.mark.parametrize("choice", ["random", "a model"])
    def test_who_was_chosen_before_loading_acts(self, tmp_path, choice):
        model = make()
        model.save(tmp_path / "team")
        adversary_path(tmp_path / "team").unlink()
        env = games()
        env.set_opponent("random" if choice == "random" else model.opponent)
        loaded = MAPPO.load(tmp_path / "team", env=env, device="cpu")
        assert loaded.opponent is None
        assert env.learner is None
        loaded.learn(32)

    def test_a_chosen_model_of_ours_is_saved_too(self, tmp_path):
        first, env = make(), games()
        env.set_opponent(first.opponent)
        make(env).save(tmp_path / "team")
        loaded = MAPPO.load(tmp_path / "team", env=games(), device="cpu")
        assert same_weights(loaded.opponent, first.opponent)

    def test_random_opponents_leave_no_file(self, tmp_path):
        env = games()
        env.set_opponent("random")
        make(env).save(tmp_path / "team")
        assert [path.name for path in tmp_path.iterdir()] == ["team.zip"]

    def test_checkpoints_and_the_best_model_have_their_adversaries(self, tmp_path):
        model = make()
        best = {"best_model_save_path": str(tmp_path / "best"), "n_eval_episodes": 1, "verbose": 0}
        callbacks = [
            CheckpointCallback(8, str(tmp_path / "all")),
            TeamEvalCallback(games(seed=9), eval_freq=8, **best),
        ]
        model.learn(64, callback=callbacks)
        names = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.zip")}
        assert names == {
            f"{stem}{end}"
            for stem in ("all/rl_model_32_steps", "all/rl_model_64_steps", "best/best_model")
            for end in (".zip", ".adversary.zip")
        }
        loaded = MAPPO.load(tmp_path / "all/rl_model_64_steps", env=games(), device="cpu")
        assert not same_weights(loaded.opponent, make().opponent)

    def test_training_that_was_saved_and_loaded_is_the_one_that_was_not(self, tmp_path):
        # whole episodes, so that both begin new ones; the random numbers are set by hand
        straight, interrupted = make().learn(64), make().learn(64)
        interrupted.save(tmp_path / "team")
        resumed = MAPPO.load(tmp_path / "team", env=games(), device="cpu")
        for model in (straight, resumed):
            model.set_env(games(seed=8))
            th.manual_seed(1)
            np.random.seed(1)
            model.learn(64, reset_num_timesteps=False)
        assert same_weights(straight, resumed)
        assert same_weights(straight.opponent, resumed.opponent)


class TestForeignEnvironments:
    def speaker_and_listener(self):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from mpe2 import simple_speaker_listener_v4

            return simple_speaker_listener_v4.parallel_env(max_cycles=5)

    @pytest.mark.parametrize("n_processes", [1, 2])
    def test_any_environment_may_have_a_team_that_differs_in_both_spaces(self, n_processes):
        env = share_parameters(self.speaker_and_listener, 2, n_processes, team=["listener_0"])
        assert env.observation_space.shape == (11,)
        assert env.action_space.n == 5
        assert env.opponents.observation_space.shape == (3,)
        assert env.opponents.action_space.n == 3
        model = make(env)
        before = flat(model).clone(), flat(model.opponent).clone()
        model.learn(2 * 16)
        assert model._n_updates == model.opponent._n_updates == 4
        assert not th.equal(flat(model), before[0])
        assert not th.equal(flat(model.opponent), before[1])
        env.close()

    def test_a_single_world_of_pettingzoo_is_taken_as_it_is(self):
        model = make(predator_prey_v0.parallel_env(max_cycles=4))
        assert model.opponent.agents == ["agent_0"]
        model.learn(24)


def test_loading_first_and_choosing_the_environment_later_keeps_the_adversary(tmp_path):
    model = make().learn(64)
    model.save(tmp_path / "team")
    loaded = MAPPO.load(tmp_path / "team", device="cpu")
    loaded.set_env(games())
    assert same_weights(loaded.opponent, model.opponent)


def test_an_older_model_loaded_into_the_same_environment_brings_its_own_adversary(tmp_path):
    env = games()
    model = make(env).learn(64)
    model.save(tmp_path / "old")
    old = flat(model.opponent).clone()
    model.learn(64)
    MAPPO.load(tmp_path / "old", env=env, device="cpu")
    assert th.equal(flat(env.opponent), old)


def test_a_second_team_on_an_environment_begins_with_opponents_of_its_own():
    env = games()
    first = make(env).learn(32)
    make(env)
    assert env.opponent is not first.opponent


def test_opponents_with_other_rollouts_than_the_team_are_refused():
    env = games()
    env.set_opponent(make(env).opponent, learning=True)
    with pytest.raises(ValueError, match="n_steps=8 and the team 4"):
        make(env, n_steps=4).learn(64)


def test_two_teams_may_take_turns_in_an_environment():
    env = games()
    first, second = make(env), make(env)
    for team in (first, second, first):
        team.learn(32)
        assert env.opponent is team.opponent
    assert first.opponent._n_updates == 2 * second.opponent._n_updates


def test_a_team_that_never_met_its_adversary_saves_it_again(tmp_path):
    model = make().learn(64)
    model.save(tmp_path / "team")
    MAPPO.load(tmp_path / "team", device="cpu").save(tmp_path / "copy")
    again = MAPPO.load(tmp_path / "copy", env=games(), device="cpu")
    assert same_weights(again.opponent, model.opponent)


def test_an_evaluation_environment_used_again_has_the_new_teams_opponents():
    eval_env = games(seed=9)
    for _ in range(2):
        model = make().learn(32, callback=TeamEvalCallback(eval_env, eval_freq=8, verbose=0))
    assert eval_env.opponent is model.opponent


def test_the_adversarys_counters_are_saved(tmp_path):
    model = make().learn(64)
    model.save(tmp_path / "team")
    loaded = MAPPO.load(tmp_path / "team", env=games(), device="cpu")
    assert loaded.opponent._n_updates == model.opponent._n_updates == 4


def test_a_missing_adversary_is_missed_every_time(tmp_path):
    make().learn(32).save(tmp_path / "team")
    (tmp_path / "team.adversary.zip").unlink()
    model = MAPPO.load(tmp_path / "team", device="cpu")
    for _ in range(2):
        with pytest.raises(FileNotFoundError, match="no adversary beside the team"):
            model.set_env(games())


def test_who_has_learned_beside_the_team_is_saved_whoever_acts_now(tmp_path):
    model = make().learn(32)
    model.env.unwrapped.set_opponent("random")
    model.save(tmp_path / "team")
    loaded = MAPPO.load(tmp_path / "team", env=games(), device="cpu")
    assert same_weights(loaded.opponent, model.opponent)
    env = games()
    env.set_opponent("random")
    MAPPO.load(tmp_path / "team", env=env, device="cpu").save(tmp_path / "copy")
    again = MAPPO.load(tmp_path / "copy", env=games(), device="cpu")
    assert same_weights(again.opponent, model.opponent)


def test_another_teams_adversary_is_not_left_beside_a_team(tmp_path):
    make().learn(32).save(tmp_path / "team")
    env = games()
    env.set_opponent("random")
    make(env).learn(32).save(tmp_path / "team")
    assert not (tmp_path / "team.adversary.zip").exists()


def test_evaluations_meet_opponents_that_decide_as_in_training():
    env, eval_env = games(), games(seed=9)
    env.set_opponent(make().opponent, deterministic=True)
    make(env).learn(32, callback=TeamEvalCallback(eval_env, eval_freq=8, verbose=0))
    assert eval_env.worlds.opponents.deterministic


def test_a_stopped_rollout_collects_no_more():
    model = make()
    model.learn(32, callback=lambda *_: model.num_timesteps < 8)
    steps = model.opponent.num_timesteps
    evaluate_team(model, model.env, n_episodes=2)
    assert model.opponent.num_timesteps == steps
