"""GRU policies: sequences, hidden states, and a task that needs a memory."""

import numpy as np
import pytest
import torch as th
from conftest import TwoOnALine
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_e2c import MAPPO, evaluate_team, share_parameters
from sb3_e2c.sequences import Cut, Memory, cut_at_ends, initial_memory, packed_rows, random_groups

SMALL = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "device": "cpu", "seed": 0}
TINY = {"net_arch": [8], "gru_hidden_size": 4}


def line(n_worlds=2, **kwargs):
    return share_parameters(lambda: TwoOnALine(**kwargs), n_worlds)


def make(env=None, **kwargs):
    kwargs = {"policy_kwargs": TINY, **SMALL, **kwargs}
    return MAPPO("GruPolicy", env or line(), **kwargs)


def collect(model):
    """One rollout, without learning from it."""
    _, callback = model._setup_learn(32, reset_num_timesteps=model._last_obs is None)
    callback.on_training_start({}, {})
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    return model.rollout_buffer


def parameters(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


class TestSequences:
    # Five steps of two worlds; world 0's episodes end with steps 1 and 4, world 1's with step 2.
    DONES = np.array([[0, 0], [1, 0], [0, 1], [0, 0], [1, 0]], bool)

    def test_worlds_are_cut_after_every_end_and_sorted_by_length(self):
        cut = cut_at_ends(self.DONES)
        pieces = sorted(zip(*(field.tolist() for field in cut), strict=True))
        assert pieces == [(0, 0, 2), (0, 2, 3), (1, 0, 3), (1, 3, 2)]  # world, start, length
        assert cut.lengths.tolist() == [3, 3, 2, 2]

    def test_rows_come_by_step_and_the_longest_sequence_first(self):
        cut = Cut(np.array([0, 1, 0]), np.array([2, 0, 0]), np.array([3, 3, 2]))
        rows, batch_sizes = packed_rows(cut, n_worlds=2)
        # (step, world): (2,0) (0,1) (0,0) | (3,0) (1,1) (1,0) | (4,0) (2,1)
        assert rows.tolist() == [4, 1, 0, 6, 3, 2, 8, 5]
        assert batch_sizes.tolist() == [3, 3, 2]

    def test_all_sequences_together_hold_every_step_once(self):
        rng = np.random.default_rng(0)
        dones = rng.random((30, 7)) < 0.2
        rows, _ = packed_rows(cut_at_ends(dones), 7)
        assert sorted(rows.tolist()) == list(range(30 * 7))
        groups = list(random_groups(cut_at_ends(dones), 50))
        assert len(groups) == 5  # 210 steps, at most about 50 in a group
        rows = np.concatenate([packed_rows(group, 7)[0] for group in groups])
        assert sorted(rows.tolist()) == list(range(30 * 7))

    @pytest.mark.parametrize("seed", range(10))
    def test_groups_have_about_equal_numbers_of_steps(self, seed):
        np.random.seed(seed)
        lengths = np.array([40] * 10 + [2] * 200)  # 800 steps
        cut = Cut(np.arange(210), np.zeros(210, int), lengths)
        sizes = [int(group.lengths.sum()) for group in random_groups(cut, 200)]
        assert sum(sizes) == 800
        assert max(sizes) <= 200 + 40  # half a sequence too many at either end

    def test_only_sequences_from_the_rollouts_start_carry_a_state_over(self):
        cut = Cut(np.array([1, 0]), np.array([0, 2]), np.array([3, 2]))
        states = th.tensor([[[1.0]], [[2.0]]])
        memory = initial_memory(cut, Memory(states, states, states))
        assert memory.actor.flatten().tolist() == [2.0, 0.0]


def step_by_step(model, buffer):
    """Log-probabilities, values and cost values of a rollout, one step at a time."""
    policy, n_agents = model.policy, model.n_agents
    actor, value, cost = (states.flatten(0, 1)[None] for states in buffer.initial)
    log_probs, values, cost_values = [], [], []
    for t in range(buffer.buffer_size):
        obs = th.as_tensor(buffer.observations[t])
        joint = obs.reshape(buffer.n_worlds, -1)
        _, actor = policy.actor_gru(policy.mlp_extractor.policy_net(obs)[None], actor)
        _, value = policy.value_gru(policy.mlp_extractor.value_net(joint)[None], value)
        cost_input = joint if policy.n_parties == 1 else obs
        _, cost = policy.cost_gru(policy.cost_extractor(cost_input)[None], cost)
        distribution = policy._get_action_dist_from_latent(actor[0])
        log_probs.append(distribution.log_prob(th.as_tensor(buffer.actions[t, :, 0])))
        values.append(policy.value_net(value[0]).flatten())
        cost_values.append(policy.cost_net(cost[0]).flatten())
        alive = th.as_tensor(~buffer.dones[t])
        slots = alive.repeat_interleave(n_agents)
        parties = alive.repeat_interleave(policy.n_parties)
        actor, value, cost = actor * slots[:, None], value * alive[:, None], cost * parties[:, None]
    return [th.stack(each).detach().numpy() for each in (log_probs, values, cost_values)]


@pytest.mark.parametrize("scope", ["team", "individual"])
@pytest.mark.parametrize("length", [3, 4, 20], ids=["uneven", "even", "longer than the rollout"])
def test_sequences_are_evaluated_as_step_by_step(scope, length):
    model = make(line(length=length), cost_limits=1.0, cost_scope=scope)
    for _ in range(2):  # the second rollout begins in the middle of episodes
        buffer = collect(model)
        expected = step_by_step(model, buffer)
        got = (buffer.log_probs, buffer.values, buffer.cost_values.reshape(8, -1))
        for ours, theirs in zip(got, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-5)
    if length == 20:
        assert buffer.initial.actor.abs().sum() > 0


def test_a_world_alone_is_evaluated_as_among_others():
    model = make(line(n_worlds=3, length=5, spread=4))
    buffer = collect(model)
    cut = cut_at_ends(buffer.dones)
    alone = Cut(*(field[cut.worlds == 1] for field in cut))
    inputs = buffer._network_inputs()
    rows, batch_sizes = packed_rows(alone, 3)
    from sb3_e2c.sequences import Sequences

    sequences = Sequences(th.as_tensor(batch_sizes), initial_memory(alone, buffer.initial))
    result = model.policy.evaluate_steps(*(each[rows] for each in inputs), sequences)
    steps = rows // 3
    expected = buffer.values.reshape(8, 3, 2)[steps, 1]
    np.testing.assert_allclose(result.values.detach().numpy(), expected, atol=1e-6)


def test_the_ratio_is_exactly_1_before_the_first_step():
    model = make(line(length=5), batch_size=1000)
    buffer = collect(model)
    samples = buffer.samples(model.policy, model.multipliers.values, normalize_values=False)
    ((batch, sequences),) = buffer.minibatches(samples, 1000)
    inputs = (batch.observations, batch.actions, batch.critic_states)
    new = model.policy.evaluate_steps(*inputs, sequences).log_prob
    assert th.exp(new - batch.old_log_prob).eq(1.0).all()


def test_a_time_limit_is_bootstrapped_with_the_state_of_the_last_step():
    model = make(line(n_worlds=1, length=4), gamma=1.0)
    buffer = collect(model)
    policy = model.policy
    hidden = None
    for t in range(4):
        joint = th.as_tensor(buffer.observations[t]).reshape(1, -1)
        _, hidden = policy.value_gru(policy.mlp_extractor.value_net(joint)[None], hidden)
    moved = 1 + buffer.actions[:4, :, 0]
    left, right = np.array([0.0, 1.0]) + moved.sum(axis=0)
    last = th.tensor([[left, right, 4.0, right, left, 4.0]], dtype=th.float32)
    _, hidden = policy.value_gru(policy.mlp_extractor.value_net(last)[None], hidden)
    value = policy.value_net(hidden[0]).detach().numpy()[0]
    np.testing.assert_allclose(buffer.rewards[3], 1 + buffer.actions[3, :, 0] + value, atol=1e-5)


@pytest.mark.parametrize("scope", ["team", "individual"])
def test_with_lambda_zero_it_is_mappo_bit_for_bit(scope):
    constrained = make(cost_limits=np.inf, cost_scope=scope).learn(96)
    free = make().learn(96)
    for name, parameter in free.policy.named_parameters():
        assert constrained.policy.get_parameter(name).equal(parameter)


def test_the_same_seed_gives_the_same_parameters_bit_for_bit():
    first, second = (make(line(spread=5), cost_limits=2.0).learn(96) for _ in range(2))
    assert parameters(first).equal(parameters(second))


def test_an_agent_alone_acts_as_in_the_team_and_a_new_episode_forgets():
    model = make().learn(64)
    obs = np.random.default_rng(0).random((3, 4, 3), np.float32)  # three steps of four slots
    together, state = [], None
    for step in obs:
        actions, state = model.predict(step, state, deterministic=True)
        together.append(actions)
    alone, own = [], None
    for step in obs:
        action, own = model.predict(step[2], own, deterministic=True)
        alone.append(action)
    assert np.array_equal([actions[2] for actions in together], alone)
    np.testing.assert_allclose(state[0][:, 2:3], own[0], atol=1e-6)
    assert state[0].shape == (1, 4, 4)
    starts = np.array([False, False, True, False])
    _, after = model.predict(obs[0], state, episode_start=starts)
    _, fresh = model.predict(obs[0])
    np.testing.assert_allclose(after[0][0, 2], fresh[0][0, 2], atol=1e-6)
    assert not np.allclose(after[0][0, 1], fresh[0][0, 1])
    for start, expected in ((True, model.predict(step[2])), (False, model.predict(step[2], own))):
        _, found = model.predict(step[2], own, episode_start=start)
        np.testing.assert_allclose(found[0], expected[1][0])
    with pytest.raises(ValueError, match=r"episode_start has the shape \(2,\); expected \(1,\)"):
        model.predict(step[2], own, episode_start=[True, False])


def test_a_loaded_model_goes_on(tmp_path):
    model = make(cost_limits=2.0).learn(64)
    model.save(tmp_path / "model")
    loaded = MAPPO.load(tmp_path / "model", env=line(n_worlds=3), device="cpu")
    assert parameters(loaded).equal(parameters(model))
    loaded.learn(48, reset_num_timesteps=False)
    assert loaded.num_timesteps == 64 + 48
    model.policy.save(tmp_path / "policy")
    policy = type(model.policy).load(tmp_path / "policy")
    obs = np.ones((1, 3), np.float32)
    assert policy.predict(obs, deterministic=True)[0] == model.predict(obs, deterministic=True)[0]


class Cue(ParallelEnv):
    """Two agents see a cue, 0 or 1, in the first step only, and must repeat it in the last one."""

    metadata = {"name": "cue_v0"}  # noqa: RUF012
    render_mode = None

    def __init__(self, delay=6):
        self.delay = delay
        self.possible_agents = ["a", "b"]
        self.rng = np.random.default_rng()

    def observation_space(self, agent):
        return spaces.Box(-1.0, 1.0, (2,))

    def action_space(self, agent):
        return spaces.Discrete(2)

    def observe(self):
        cues = self.cues if self.t == 0 else (0.5, 0.5)
        return {
            a: np.array([2 * cue - 1, self.t / self.delay], np.float32)
            for a, cue in zip(self.agents, cues, strict=True)
        }

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.t, self.agents, self.cues = 0, self.possible_agents[:], self.rng.integers(2, size=2)
        return self.observe(), {a: {} for a in self.agents}

    def step(self, actions):
        last = self.t == self.delay
        cues = zip(self.agents, self.cues, strict=True)
        rewards = {a: float(last and actions[a] == cue) for a, cue in cues}
        self.t += 1
        observations = self.observe()
        ended = dict.fromkeys(self.agents, last)
        infos = {a: {} for a in self.agents}
        if last:
            self.agents = []
        return observations, rewards, ended, dict.fromkeys(ended, False), infos


@pytest.mark.parametrize(
    ("policy", "low", "high"), [("GruPolicy", 1.9, 2.0), ("MlpPolicy", 0.0, 1.4)]
)
def test_a_gru_remembers_what_an_mlp_cannot(policy, low, high):
    # guessing earns 1/2 for each of two agents
    env = share_parameters(Cue, n_worlds=16)
    model = MAPPO(
        policy, env, n_steps=7, batch_size=10_000, n_epochs=10, gamma=1.0, learning_rate=1e-3,
        policy_kwargs={"net_arch": [32]}, device="cpu", seed=0,
    )  # fmt: skip
    model.learn(20_000)
    result = evaluate_team(model, env, n_episodes=64)
    assert low <= result.mean_return <= high
