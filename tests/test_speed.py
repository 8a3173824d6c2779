"""The speed benchmark runs and reports; how fast is never a test."""

import json
import sys

import numpy as np
import pytest

from sb3_e2c.zoo import peers, speed

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
SMALL = ["--rounds", "1", "--threads", "1", "--worlds", "1", "--epochs", "1", "--minibatches", "1"]


@pytest.fixture(autouse=True)
def _without_libraries_of_this_machine(monkeypatch):
    monkeypatch.setattr(peers, "is_installed", lambda _: False)
    monkeypatch.setattr(speed, "is_installed", lambda _: False)


@pytest.mark.parametrize(
    ("env", "policy", "peer"),
    [
        ("rover", "mlp", "SB3 PPO"),
        ("simple_spread", "gru", "sb3-contrib RecurrentPPO"),
        ("predator_prey", "mlp", "SB3 PPO"),
    ],
)
def test_it_compares_with_a_peer_and_says_where_the_time_goes(tmp_path, capsys, env, policy, peer):
    file = tmp_path / "out.json"
    speed.main(["--env", env, "--policy", policy, "--json", str(file), *SMALL])
    outcome = json.loads(file.read_text())
    ours, theirs = outcome["results"]
    assert peer in theirs["name"]
    (ratio,) = outcome["ratios"].values()
    assert ratio == pytest.approx(ours["steps_per_second"] / theirs["steps_per_second"])
    for result in outcome["results"]:
        shares = result["shares"]
        assert set(shares) >= {"environment", "inference", "update", "everything else"}
        assert sum(shares.values()) == pytest.approx(1.0)
        assert all(0.0 <= share <= 1.0 for share in shares.values())
    assert f"ratio to {theirs['name']}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "same"),
    [
        (["--env", "simple_spread"], True),
        (["--env", "rover"], False),
        (["--env", "rover", "--same-environment"], True),
    ],
)
def test_it_says_whether_the_environment_is_the_same_for_all(tmp_path, capsys, flags, same):
    file = tmp_path / "out.json"
    speed.main([*flags, "--json", str(file), *SMALL])
    assert json.loads(file.read_text())["same_environment"] is same
    first, *_ = capsys.readouterr().out.splitlines()
    assert ("the same on all sides" in first) is same


def test_on_request_ours_steps_the_worlds_of_the_peers():
    args = speed.make_parser().parse_args(["--worlds", "2"])
    task = speed.TASKS["predator_prey"]
    plan = speed._plan(args, task)
    backends = [type(speed._our_worlds(task, plan, same).worlds).__name__ for same in (0, 1)]
    assert backends == ["OpponentWorlds", "SuperSuitWorlds"]


def test_peers_get_the_rows_of_the_team_only():
    task = speed.TASKS["predator_prey"]
    env, theirs = task.make_env(), task.peers_env()
    assert theirs.possible_agents == env.metadata["team"]
    assert len(env.possible_agents) == len(theirs.possible_agents) + 1
    observations, _ = env.reset(seed=3)
    shown, _ = theirs.reset(seed=3)
    assert all(np.array_equal(shown[agent], observations[agent]) for agent in theirs.agents)
    for _ in range(25):
        assert theirs.agents == theirs.possible_agents
        *answers, infos = theirs.step(dict.fromkeys(theirs.agents, 0))
        assert all(set(each) >= set(theirs.possible_agents) for each in (*answers, infos))
    assert theirs.agents == []


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env", "simple_spred"], "simple_spread"),
        (["--rounds", "0"], "--rounds is 0; expected at least 1"),
        (["--threads", "0"], "--threads is 0; expected at least 1"),
        (["--clock", "cpu"], "expected --threads 1"),
        (["--policy", "lstm"], "invalid choice"),
        (["--json", "."], "--json . is a folder"),
        (["--peer", "benchmarl"], "BenchMARL is not installed; pip install benchmarl"),
        (["--peer", "onpolicy=."], "did you mean"),
        (["--peer", "mappo-l"], "--peer mappo-l=PATH"),
        (["--peer", "mappo-l=/no/such/folder"], "/no/such/folder is no folder"),
        (["--peer", "on-policy=/"], "No module named 'onpolicy'"),
        (["--peer", "safepo=."], "continuous actions only; choose --policy mlp --env rover"),
    ],
)
def test_mistakes_are_one_line_and_exit_status_2(capsys, flags, message):
    with pytest.raises(SystemExit) as stop:
        speed.main([*flags, "--worlds", "1"] if "--worlds" not in flags else flags)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


RUNNER = """
import numpy as np
import torch
import wandb, imageio
from tensorboardX import SummaryWriter

class MPERunner:
    def __init__(self, config):
        args = config["all_args"]
        assert not args.use_wandb
        self.writer = SummaryWriter(config["run_dir"] / "logs")
        self.writer.add_scalars("settings", vars(args))
        self.envs, self.trainer, self.policy = config["envs"], self, self
        self.n_rollout_threads = args.n_rollout_threads
        self.shape = (args.n_rollout_threads, config["num_agents"])
        self.log, self.args = [], args

    def warmup(self):
        self.envs.reset()
        ones = np.ones((self.args.episode_length, *self.shape, 1), np.float32)
        names = ("share_obs", "obs", "rnn_states", "rnn_states_critic", "masks")
        self.buffer = type("Buffer", (), dict.fromkeys(names, ones))

    def prep_rollout(self): pass
    def get_actions(self, *inputs):
        assert all(each.shape == (np.prod(self.shape), 1) for each in inputs)
        return [torch.zeros(np.prod(self.shape), 2)] * 5
    def insert(self, data): self.log.append(data)
    def compute(self): self.log.append("compute")
    def train(self): self.log.append("train")
"""
VECTORS = """
import numpy as np

class DummyVecEnv:
    def __init__(self, functions): self.envs = [make() for make in functions]
    def reset(self): return np.array([env.reset() for env in self.envs])
    def step(self, actions):
        return [np.array(x) for x in zip(*(e.step(a) for e, a in zip(self.envs, actions)))]
"""
CONFIG = """
import argparse

def get_config():
    parser = argparse.ArgumentParser()
    parser.add_argument("--lr", type=float, default=5e-4)
    return parser
"""


@pytest.fixture
def checkout(tmp_path):
    """A repository that looks like on-policy from outside."""
    files = {
        "config.py": CONFIG,
        "envs/env_wrappers.py": VECTORS,
        "runner/shared/mpe_runner.py": RUNNER,
    }
    for name, content in files.items():
        file = tmp_path / "onpolicy" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("onpolicy")]:
        del sys.modules[name]


def test_a_repository_trains_by_its_own_loop_with_our_settings(checkout):
    args = speed.make_parser().parse_args(["--worlds", "2", "--epochs", "7", "--policy", "gru"])
    plan = speed._plan(args, speed.TASKS["rover"])
    path = list(sys.path)
    learner = peers.on_policy(plan, checkout)
    assert learner.name == "on-policy R-MAPPO"
    assert learner.iterate() == 80 * 2 * 6
    runner = learner.hooks[-1][1]
    *stored, compute, train = runner.log
    assert (len(stored), compute, train) == (80, "compute", "train")
    observations, rewards, dones, _, *chosen = stored[-1]
    assert [len(chosen), observations.shape, rewards.shape] == [5, (2, 6, 8), (2, 6, 1)]
    assert dones.all()  # the episode's end, after 80 steps
    settings = vars(runner.args)
    expected = {"ppo_epoch": 7, "num_mini_batch": 4, "data_chunk_length": 80, "lr": 5e-4}
    assert {name: settings[name] for name in expected} == expected
    assert sys.path == path  # nothing of it stays behind
    assert not any(isinstance(module, peers._StandIn) for module in sys.modules.values())


def test_a_repository_that_has_changed_is_reported_in_one_line(checkout, capsys):
    (checkout / "onpolicy" / "config.py").write_text("")
    with pytest.raises(SystemExit):
        speed.main(["--peer", f"on-policy={checkout}", "--worlds", "1"])
    assert "made for commit de66d7a) cannot be used: module" in capsys.readouterr().err
