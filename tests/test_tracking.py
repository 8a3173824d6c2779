"""What reaches the dashboards: TensorBoard's files, and Weights & Biases through RL-Zoo's flags."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch.utils.tensorboard.writer as torch_writer

pytest.importorskip("rl_zoo3")

from conftest import TwoOnALine
from stable_baselines3.common.logger import configure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_e2c import MAPPO, share_parameters
from sb3_e2c.zoo import train

ENV = "MultiRover-6-3-v0"
ROLLOUT = 2 * 6 * 80
SMALL = ["n_envs:2", "n_epochs:1", "batch_size:480", "policy_kwargs.net_arch:[8]"]
SHOWN = {
    *("rollout/ep_rew_mean", "rollout/ep_cost_mean", "rollout/cost_limit", "rollout/ep_oem_mean"),
    *("train/lambda", "train/approx_kl", "time/env_steps"),
}

# Does to TensorBoard's writer what wandb.init(sync_tensorboard=True) does.
WANDB = """
import json
import torch.utils.tensorboard.writer as writer

calls, synced = [], []

class Config(dict):
    def setdefaults(self, values):
        calls.append(("config", json.loads(json.dumps(values))))

class Run:
    config = Config()

def init(**kwargs):
    calls.append(("init", json.loads(json.dumps(kwargs))))
    class Writer(writer.EventFileWriter):
        def __init__(self, logdir, *args, **kwargs):
            synced.append(logdir)
            super().__init__(logdir, *args, **kwargs)
    writer.EventFileWriter = Writer
    return Run()
"""


def run_train(folder, *flags, steps=2 * ROLLOUT):
    argv = ["--algo", "e2c_t", "--env", ENV, "-n", str(steps), "-f", str(folder), "--seed", "1"]
    argv += ["--eval-freq", "-1", "--device", "cpu", "--verbose", "0"]
    return train.train([*argv, *flags, "-params", *SMALL])


def scalars(folder):
    """Tag -> [(step, value)] in the event files below a folder."""
    (file,) = Path(folder).rglob("events*")
    events = EventAccumulator(str(file)).Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


def test_tensorboard_has_reward_cost_limit_multiplier_bonus_and_divergence(tmp_path):
    run_train(tmp_path / "logs", "-tb", str(tmp_path / "tb"))
    shown = scalars(tmp_path / "tb")
    assert shown.keys() >= SHOWN
    assert shown["rollout/cost_limit"] == [(ROLLOUT, 20), (2 * ROLLOUT, 20)]
    assert [step for step, _ in shown["train/approx_kl"]] == [2 * ROLLOUT, 2 * ROLLOUT]


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ([3, 5], {"rollout/cost_limit_0": 3, "rollout/cost_limit_1": 5}),
        (4, {"rollout/cost_limit": 4}),
        (None, {}),
    ],
)
def test_every_constraint_has_its_limit_in_the_log(tmp_path, limits, expected):
    n_costs = 2 if limits == [3, 5] else 1
    env = share_parameters(lambda: TwoOnALine(n_costs=n_costs), 1, seed=0)
    model = MAPPO("MlpPolicy", env, n_steps=8, batch_size=16, n_epochs=1, cost_limits=limits)
    model.set_logger(configure(str(tmp_path), ["json"]))
    model.learn(16)
    model.logger.close()
    row = json.loads((tmp_path / "progress.json").read_text().splitlines()[0])
    assert {key: row[key] for key in row if "cost_limit" in key} == expected


@pytest.fixture
def wandb(tmp_path, monkeypatch):
    """A package of that name that writes down what is asked of it."""
    (tmp_path / "stub").mkdir()
    (tmp_path / "stub" / "wandb.py").write_text(WANDB)
    monkeypatch.syspath_prepend(tmp_path / "stub")
    monkeypatch.setattr(torch_writer, "EventFileWriter", torch_writer.EventFileWriter)
    monkeypatch.chdir(tmp_path)
    import wandb  # the one above

    yield wandb
    del sys.modules["wandb"]


def test_weights_and_biases_gets_settings_and_every_number(wandb):
    flags = ["--track", "--wandb-project-name", "teams", "--wandb-entity", "lab", "-tags", "a", "b"]
    run = run_train("logs", *flags)
    (_, init), (_, config) = wandb.calls
    assert (init["project"], init["entity"]) == ("teams", "lab")
    assert init["name"].startswith(f"{ENV}__e2c_t__1__")
    assert init["tags"][:2] == ["a", "b"]
    assert (init["sync_tensorboard"], init["config"]["seed"]) == (True, 1)
    assert config["saved_hyperparams"]["cost_limits"] == 20
    (folder,) = wandb.synced  # made after wandb.init, by the writer that it watches
    assert Path(folder).is_relative_to(Path.cwd() / "runs" / init["name"])
    assert scalars("runs").keys() >= SHOWN
    assert (run / ENV / "args.yml").is_file()


def test_tracking_without_the_package_is_one_line(tmp_path, capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *_: None if name == "wandb" else find(name, *_)
    )
    with pytest.raises(SystemExit) as exit_:
        train.main(["--track", "-f", str(tmp_path)])
    assert exit_.value.code == 2
    assert "--track needs Weights & Biases: pip install wandb" in capsys.readouterr().err
