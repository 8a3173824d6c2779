"""``sb3-e2c export``: the same actions without torch, and a card that says how to use them."""

import hashlib
import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

pytest.importorskip("rl_zoo3")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import onnx
import onnxruntime
from conftest import TwoOnALine
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_e2c import MAPPO, share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.zoo import cli, export, train
from sb3_e2c.zoo.build import make_worlds
from sb3_e2c.zoo.runs import load_model, make_env, open_run

DISCRETE, CONTINUOUS = "TwoOnALine-v0", "MultiRover-6-3-v0"
EXAMPLE = Path(__file__).parent.parent / "docs" / "export.md"
SMALL = ["n_envs:2", "n_epochs:1", "batch_size:480", "policy_kwargs.net_arch:[8]"]
PARAMS = {
    "mlp": [],
    "gru": ["policy:GruPolicy", "policy_kwargs.gru_hidden_size:8"],
}
# 2 worlds: 2 of 2 agents for 40 steps, 10 episodes; and of 6 rovers for 80 steps, one episode
ROLLOUT = {DISCRETE: 160, CONTINUOUS: 960}


@pytest.fixture(scope="module", autouse=True)
def _discrete_env():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENV_IDS, DISCRETE, TwoOnALine)
        yield


def run_train(folder, env_id, *params):
    argv = ["--algo", "c_mappo", "--env", env_id, "-n", str(2 * ROLLOUT[env_id]), "-f", str(folder)]
    argv += ["--seed", "1", "--eval-freq", "-1", "--device", "cpu", "--verbose", "0"]
    small = [*SMALL, "n_steps:40", "n_timesteps:320"] if env_id == DISCRETE else SMALL
    return train.train([*argv, "-params", *small, *params])


def run_export(folder, env_id, *flags):
    argv = ["--algo", "c_mappo", "--env", env_id, "-f", folder, "--verbose", "0", *flags]
    cli.main(["export", *(str(word) for word in argv)])


def refusal(capsys, argv):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["export", *(str(word) for word in argv)])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("sb3-e2c: error: ")
    return lines[0]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log folder with a run on the continuous environment, recurrent and normalized."""
    folder = tmp_path_factory.mktemp("logs")
    run_train(folder, CONTINUOUS, *PARAMS["gru"], "normalize:true")
    return folder


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    """The folder of its export."""
    folder = tmp_path_factory.mktemp("export") / "actor"
    run_export(trained, CONTINUOUS, "-o", folder)
    return folder


def read(folder):
    card = json.loads((folder / "card.json").read_text())
    session = onnxruntime.InferenceSession(
        folder / "actor.onnx", providers=["CPUExecutionProvider"]
    )
    return card, session


def no_memory(card, rows):
    return {name: np.zeros((rows, *shape), np.float32) for name, shape in card["memory"].items()}


def act(card, session, observation, memory):
    values = session.run(None, {"observation": observation, **memory})
    outputs = dict(zip(card["outputs"], values, strict=True))
    return outputs, {name: outputs[f"next_{name}"] for name in memory}


# ---------------------------------------------------------------------------- the same actions


@pytest.mark.parametrize("normalize", ["false", "true"])
@pytest.mark.parametrize("policy", PARAMS)
@pytest.mark.parametrize("env_id", [DISCRETE, CONTINUOUS])
def test_an_agent_alone_acts_as_in_torch_over_a_whole_episode(tmp_path, env_id, policy, normalize):
    folder = run_train(tmp_path, env_id, *PARAMS[policy], f"normalize:{normalize}")
    run_export(tmp_path, env_id)
    card, session = read(folder / "export")
    run = open_run(folder, "c_mappo", env_id)
    torch_env = make_env(run, 1, 7)  # observations normalized by VecNormalize
    raw_env = make_worlds(env_id, run.config.get("env_kwargs"), 1, 7)  # and as they are
    model = load_model(run, torch_env, device="cpu")
    observed, seen = torch_env.reset(), raw_env.reset()
    starts, state = np.ones(len(seen), bool), None
    memories = [no_memory(card, 1) for _ in seen]
    steps, over = 0, False
    while not over:
        expected, state = model.predict(observed, state, starts, deterministic=True)
        for agent, memory in enumerate(memories):
            row = seen[agent : agent + 1]
            outputs, memories[agent] = act(card, session, row, memory)
            assert outputs["action"] == pytest.approx(expected[agent : agent + 1], abs=1e-5)
        observed, _, starts, _ = torch_env.step(expected)
        seen, _, dones, _ = raw_env.step(expected)
        steps, over = steps + 1, dones.all()
    assert steps == {DISCRETE: 4, CONTINUOUS: 80}[env_id]
    assert (card["normalization"] is not None) == (normalize == "true")
    assert bool(card["memory"]) == (policy == "gru")


def test_the_hidden_state_matters(exported):
    card, session = read(exported)
    observation = np.ones((1, 18), np.float32)
    first, memory = act(card, session, observation, no_memory(card, 1))
    second, _ = act(card, session, observation, memory)
    assert not np.allclose(first["mean"], second["mean"])


def two_on_a_line(action_space, policy="MlpPolicy", spread=1, **policy_kwargs):
    """A model of two agents with another action space, untrained, and what it exports.

    Episodes have as many steps as agent_0 is ahead at the start, and 4 more.
    """

    class Other(TwoOnALine):
        batched = None

        def action_space(self, agent):
            return action_space

        def reset(self, seed=None, options=None):
            result = super().reset(seed, options)
            self.length = 4 + self.start
            return result

        def step(self, actions):
            fast = {agent: int(np.ravel(action)[0] > 0) for agent, action in actions.items()}
            return super().step(fast)

    th.manual_seed(0)
    worlds = export.CHECKED_WORLDS
    env = share_parameters(lambda: Other(spread=spread), worlds, backend="supersuit")
    model = MAPPO(policy, env, n_steps=8, batch_size=8, policy_kwargs=policy_kwargs, seed=0)
    with th.no_grad():  # so that the actions differ, and leave their bounds
        model.policy.action_net.weight.mul_(300)
    actor = export.Actor(model)
    return model, actor, export.to_onnx(actor)


def outputs_of(content, actor, observation):
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return dict(zip(actor.outputs, session.run(None, {"observation": observation}), strict=True))


OBSERVATIONS = np.array([[0, 1, 0], [3, 9, 2], [5, 2, 3]], np.float32)


def test_worlds_that_end_earlier_are_compared_beyond_the_end_of_their_episode():
    model, actor, content = two_on_a_line(spaces.Discrete(2), "GruPolicy", 9, gru_hidden_size=8)
    lengths = 4 + np.array(model.get_env().reset())[::2, 0]  # by the first agent's position
    assert len(set(lengths)) > 1
    model.get_env().seed(0)
    assert export.compare(model, actor, content, seed=0).agent_steps == 2 * lengths.sum()


def test_continuous_actions_are_clipped_and_their_means_are_not():
    box = spaces.Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 0.5], np.float32))
    model, actor, content = two_on_a_line(box, log_std_init=-1.0)
    outputs = outputs_of(content, actor, OBSERVATIONS)
    assert np.abs(outputs["mean"]).max() > 1
    assert np.array_equal(outputs["action"], np.clip(outputs["mean"], box.low, box.high))
    assert np.array_equal(outputs["log_std"], np.full((3, 2), -1.0))
    expected = model.predict(OBSERVATIONS, deterministic=True)[0]
    assert outputs["action"] == pytest.approx(expected, abs=1e-5)
    export.compare(model, actor, content, seed=0)


def test_an_action_may_have_any_shape():
    box = spaces.Box(-1.0, 1.0, (2, 2))
    model, actor, content = two_on_a_line(box)
    outputs = outputs_of(content, actor, OBSERVATIONS)
    assert outputs["action"].shape == outputs["log_std"].shape == (3, 2, 2)
    expected = model.predict(OBSERVATIONS, deterministic=True)[0]
    assert outputs["action"] == pytest.approx(expected, abs=1e-5)


def test_logits_are_logarithms_of_probabilities():
    _, actor, content = two_on_a_line(spaces.Discrete(2))
    outputs = outputs_of(content, actor, OBSERVATIONS)
    assert np.exp(outputs["logits"]).sum(axis=1) == pytest.approx([1, 1, 1])
    assert outputs["action"].tolist() == outputs["logits"].argmax(axis=1).tolist()


def test_actions_of_several_parts_have_logits_for_each():
    model, actor, content = two_on_a_line(spaces.MultiDiscrete([2, 3]))
    outputs = outputs_of(content, actor, OBSERVATIONS)
    assert outputs["logits"].shape == (3, 5)
    assert np.exp(outputs["logits"][:, 2:]).sum(axis=1) == pytest.approx([1, 1, 1])
    expected = model.predict(OBSERVATIONS, deterministic=True)[0]
    assert outputs["action"].tolist() == expected.tolist()
    export.compare(model, actor, content, seed=0)


class Squares(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, get_flattened_obs_dim(observation_space))

    def forward(self, observations):
        return observations**2


class Unknown(Squares):
    def forward(self, observations):
        return th.linalg.matrix_exp(observations[:, None] * observations[..., None])[:, 0]


def test_features_extractors_are_exported():
    model, actor, content = two_on_a_line(spaces.Discrete(2), features_extractor_class=Squares)
    assert export.compare(model, actor, content, seed=0).agent_steps == 4 * 4 * 2
    nodes = [node.op_type for node in onnx.load_from_string(content).graph.node]
    assert "Pow" in nodes


def test_what_onnx_cannot_express_is_said():
    with pytest.raises(export.UserError, match=r"cannot express this actor in ONNX: .*matrix"):
        two_on_a_line(spaces.Discrete(2), features_extractor_class=Unknown)


def test_only_the_actor_is_exported(exported):
    model = onnx.load(exported / "actor.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [(each.domain, each.version) for each in model.opset_import] == [("", export.OPSET)]
    # 18 -> 8, GRU 8 -> 8 (3 gates, two biases), 8 -> 2; 2 bounds, deviations, mean and scale of 18
    networks = (18 * 8 + 8) + (2 * 8 * 24 + 2 * 24) + (8 * 2 + 2)
    sizes = [int(np.prod(each.dims)) for each in model.graph.initializer]
    assert networks <= sum(sizes) <= networks + 2 * 2 + 2 + 2 * 18


# ---------------------------------------------------------------------------- the card


def test_the_card_says_what_the_actor_needs(exported):
    card = json.loads((exported / "card.json").read_text())
    assert (card["format"], card["format_version"]) == ("sb3-e2c actor", 1)
    assert card["inputs"] == ["observation", "state"]
    assert card["outputs"] == ["action", "mean", "log_std", "next_state"]
    assert card["memory"] == {"state": [8]}
    assert card["observation_space"]["shape"] == [18]
    assert card["observation_space"]["dtype"] == "float32"
    box = {"type": "Box", "shape": [2], "low": [-1.0, -1.0], "high": [1.0, 1.0]}
    assert card["action_space"] == box
    assert len(card["normalization"]["mean"]) == 18
    assert card["agents"] == [f"rover_{agent}" for agent in range(6)]
    assert (card["cost_limits"], card["constrained"]) == ([20.0], True)
    assert (card["algo"], card["env"]) == ("c_mappo", CONTINUOUS)
    assert card["training_steps"] == 2 * ROLLOUT[CONTINUOUS]
    assert card["versions"]["torch"] == importlib.metadata.version("torch")
    assert card["sha256"] == hashlib.sha256((exported / "actor.onnx").read_bytes()).hexdigest()
    checked = card["compared_with_torch"]
    assert (checked["episodes"], checked["agent_steps"]) == (4, 4 * 80 * 6)
    assert checked["max_difference"] <= 1e-5


def test_spaces_are_plain_numbers():
    largest = 3.4028234663852886e38
    open_box = export.describe(spaces.Box(-np.inf, np.array([1, np.inf], np.float32)))
    assert open_box["low"] == [-largest, -largest]
    assert open_box["high"] == [1.0, largest]
    assert export.describe(spaces.Discrete(3)) == {"type": "Discrete", "shape": [], "n": 3}
    assert export.describe(spaces.MultiDiscrete([2, 3]))["nvec"] == [2, 3]
    with pytest.raises(export.UserError, match="expected Box, Discrete, MultiDiscrete"):
        export.describe(spaces.Text(3))


def test_the_command_says_what_it_wrote(trained, tmp_path, capsys):
    cli.main(["export", "--algo", "c_mappo", "-f", str(trained), "-o", str(tmp_path), "--trust"])
    text = capsys.readouterr().out
    assert "observation, state -> action, mean, log_std, next_state" in text
    assert re.search(r"over 4 episodes, 1920 agent steps: differs by at most \d\.\de-\d\d\n", text)
    assert {path.name for path in tmp_path.iterdir()} == {"actor.onnx", "card.json"}


# ---------------------------------------------------------------------------- the example


def example():
    return re.search(r"```python\n(import .*?)```", EXAMPLE.read_text(), re.DOTALL)[1]


BLOCK = """
import sys
for name in ("torch", "sb3_e2c", "stable_baselines3", "gymnasium"):
    sys.modules[name] = None  # importing it raises ImportError
"""


def test_the_example_needs_onnxruntime_and_numpy_only(exported, trained):
    code = f"{BLOCK}{example()}\nprint(action.tolist(), outputs['mean'][0].tolist())"
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=exported.parent,
        check=True,
        capture_output=True,
        text=True,
    )
    action, mean = (
        json.loads(f"[{numbers}]") for numbers in re.findall(r"\[(.*?)\]", result.stdout)
    )
    assert len(action) == 2
    assert np.abs(action).max() <= 1
    assert action != mean
    run = open_run(trained / "c_mappo" / f"{CONTINUOUS}_1", "c_mappo", CONTINUOUS)
    env = make_env(run, 1, 0)
    model = load_model(run, env, device="cpu")
    state, nothing = None, np.tile(env.normalize_obs(np.zeros(18, np.float32)), (1, 1))
    for _ in range(80):
        expected, state = model.predict(nothing, state, deterministic=True)
    assert np.clip(mean, -1, 1) == pytest.approx(expected[0], abs=1e-5)


def test_the_example_is_as_short_as_promised():
    lines = [line for line in example().splitlines() if line and "import" not in line]
    assert len(lines) == 10


def test_sampling_with_numpy_follows_the_distribution():
    code = re.search(r"```python\n(    noise = rng.gumbel.*?)```", EXAMPLE.read_text(), re.DOTALL)[
        1
    ]
    logits = np.log(np.tile([0.7, 0.2, 0.1], (20_000, 1)))
    names = {"np": np, "rng": np.random.default_rng(0), "outputs": {"logits": logits}}
    exec("if True:\n" + code.replace("[0]", ""), names)
    shares = np.bincount(names["action"]) / 20_000
    assert shares == pytest.approx([0.7, 0.2, 0.1], abs=0.015)  # 4 standard errors


# ---------------------------------------------------------------------------- mistakes


def spoiled(actor):
    content = TO_ONNX(actor)
    with th.no_grad():
        actor.policy.action_net.bias.add_(1e-3)
    return content


TO_ONNX = export.to_onnx


def test_a_difference_is_one_line_and_leaves_the_old_export(exported, trained, capsys, monkeypatch):
    before = {path.name: path.read_bytes() for path in exported.iterdir()}
    monkeypatch.setattr(export, "to_onnx", spoiled)
    argv = ["--algo", "c_mappo", "-f", trained, "-o", exported]
    assert "onnxruntime and torch differ by 0.001 in " in refusal(capsys, argv)
    assert {path.name: path.read_bytes() for path in exported.iterdir()} == before


def test_a_difference_writes_nothing(trained, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(export, "to_onnx", spoiled)
    refusal(capsys, ["--algo", "c_mappo", "-f", trained, "-o", tmp_path / "new"])
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_are_none_are_a_difference():
    expected = {"mean": np.zeros((1, 2)), "log_std": np.zeros((1, 2))}
    with pytest.raises(export.UserError, match="differ by nan in 'mean'"):
        export._difference({**expected, "mean": np.array([[0.0, np.nan]])}, expected, [])


def test_another_action_counts_by_how_much_less_likely_it_is():
    logits = np.log([[0.5, 0.3, 0.2]])
    expected = {"action": np.array([0]), "logits": logits}
    almost = {"action": np.array([0]), "logits": logits + 4e-6}
    assert export._difference(almost, expected, [3]) == pytest.approx(4e-6)
    with pytest.raises(export.UserError, match=r"differ by 0\.51 in 'action'"):  # log(5 / 3)
        export._difference({**expected, "action": np.array([1])}, expected, [3])


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_missing_package_names_the_extra(trained, capsys, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    line = refusal(capsys, ["--algo", "c_mappo", "-f", trained])
    assert f'export needs {package}: pip install "sb3-e2c[export]"' in line


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--algo", "c_mapo"], "did you mean 'c_mappo'"),
        (["--algo", "e2c"], "sb3-e2c train --algo e2c"),
        (["--exp-id", "7"], f"{CONTINUOUS}_7"),
        (["--load-checkpoint", "7"], "rl_model_7_steps.zip"),
        (["--seed", "-1"], "--seed is -1"),
        (["-o", "/dev/null/actor"], "--out /dev/null/actor: cannot write there"),
        (["--load-best", "--load-last-checkpoint"], "not allowed with argument --load-best"),
    ],
)
def test_a_mistake_is_one_line(trained, capsys, flags, message):
    assert message in refusal(capsys, ["--algo", "c_mappo", "-f", trained, *flags])


def test_a_broken_model_is_one_line(trained, tmp_path, capsys):
    logs = shutil.copytree(trained, tmp_path / "logs")
    model = logs / "c_mappo" / f"{CONTINUOUS}_1" / f"{CONTINUOUS}.zip"
    model.write_bytes(model.read_bytes()[:5000])
    assert "no readable model" in refusal(capsys, ["--algo", "c_mappo", "-f", logs])


def test_missing_statistics_are_one_line(trained, tmp_path, capsys):
    logs = shutil.copytree(trained, tmp_path / "logs")
    (logs / "c_mappo" / f"{CONTINUOUS}_1" / f"{CONTINUOUS}.vecnormalize.npz").unlink()
    assert "observation statistics" in refusal(capsys, ["--algo", "c_mappo", "-f", logs])


def test_the_help_has_an_example(capsys):
    with pytest.raises(SystemExit):
        cli.main(["export", "--help"])
    assert "sb3-e2c export --algo e2c_t" in capsys.readouterr().out
