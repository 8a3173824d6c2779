"""The command line: what is trained, what is written, what is refused."""

import base64
import io
import json
import math
import pickle
import re
import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml

pytest.importorskip("rl_zoo3")

from stable_baselines3.common.vec_env import VecNormalize

from sb3_e2c import E2CMAPPO, GradientMultipliers, OEMRewardCallback, evaluate_team
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.multipliers import Multipliers
from sb3_e2c.zoo import cli, configuration, demo, enjoy, resume, train
from sb3_e2c.zoo.build import check_networks, make_worlds
from sb3_e2c.zoo.configuration import FOLDER, merge, read_yaml, resolve
from sb3_e2c.zoo.console import UserError, check_device, check_writable, parse_value, write_whole
from sb3_e2c.zoo.curves import plot_learning
from sb3_e2c.zoo.normalization import load_statistics, save_statistics
from sb3_e2c.zoo.parts import CLASSES, classes_in
from sb3_e2c.zoo.runs import make_env, open_run
from sb3_e2c.zoo.signatures import arguments_of

ENV = "MultiRover-6-3-v0"
N = 6
# 2 worlds of 6 rovers for 80 steps: 960 agent steps a rollout
SMALL = ["n_envs:2", "n_epochs:1", "batch_size:480", "policy_kwargs.net_arch:[8]"]
ROLLOUT = 2 * N * 80

TABLE_1 = {
    "Clipping Coefficient": 0.2,
    "Discount Factor": 0.9,
    "GAE lambda": 0.95,
    "Entropy Coefficient": 1e-3,
    "Batch Size": 4096,
    "Lag. Learning Rate": 0.05,
    "Lag. Multiplier": 1.0,
    "Actor Architecture": [128, 128],
    "Critic Architecture": [128, 128],
    "Activation Func.": "ReLU",
    "Optimizer": "Adam",
    "Quantization Level": 1,
    "k in PEnvs": 5,
    "k in Safe MaMuJoCo": 10,
    "Episode Max. Len. in Rover Domain": 80,
    "Episode Max. Len. in PEnvs": 80,
    "Episode Max. Len. in Safe MaMuJoCo": 2000,
}


def run_train(folder, *flags, algo="e2c_t", steps=2 * ROLLOUT, params=()):
    argv = ["--algo", algo, "--env", ENV, "-n", str(steps), "-f", str(folder), "--seed", "1"]
    argv += ["--eval-freq", "-1", "--device", "cpu", "--verbose", "0"]
    return train.train([*argv, *flags, "-params", *SMALL, *params])


def run_enjoy(folder, *flags, algo="e2c_t"):
    out = Path(folder) / "result.json"
    argv = ["--algo", algo, "--env", ENV, "-f", str(folder), "--no-render", "--device", "cpu"]
    enjoy.main([*argv, "--n-episodes", "4", "--n-envs", "2", "--json", str(out), *flags])
    return json.loads(out.read_text())


def refusal(capsys, main, argv):
    """The one line that a command writes to stderr before it exits with status 2."""
    with pytest.raises(SystemExit) as exit_:
        main([str(word) for word in argv])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("sb3-e2c: error: ")
    return lines[0]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log folder with one small run, with checkpoints and evaluations."""
    folder = tmp_path_factory.mktemp("logs")
    flags = ["--save-freq", str(ROLLOUT), "--eval-freq", str(ROLLOUT), "--eval-episodes", "2"]
    run_train(folder, *flags)
    return folder


@pytest.fixture
def copy(trained, tmp_path):
    """A log folder that a test may spoil."""
    return shutil.copytree(trained, tmp_path / "logs")


def run_folder(folder, number=1, algo="e2c_t"):
    return Path(folder) / algo / f"{ENV}_{number}"


# ---------------------------------------------------------------------------- hyperparameters


def table_lines():
    lines = [line for file in FOLDER.glob("*.yml") for line in file.read_text().splitlines()]
    pattern = re.compile(r"^\s*\w+: (?:&\w+ )?(.+?)  # Table 1: (.+)$")
    return [match.groups() for match in map(pattern.match, lines) if match]


def test_two_trainings_at_once_take_two_numbers(tmp_path, monkeypatch):
    rehearse = train.TeamExperimentManager._rehearse

    def be_late(manager, config):
        rehearse(manager, config)
        (tmp_path / "e2c_t" / f"{ENV}_1").mkdir(parents=True)

    monkeypatch.setattr(train.TeamExperimentManager, "_rehearse", be_late)
    run = run_train(tmp_path, steps=ROLLOUT)
    assert run.name == f"{ENV}_2"
    written = {path.name for path in run.iterdir()}
    assert written >= {ENV, f"{ENV}.zip", "monitor.csv", resume.FOLDER}
    assert not any((tmp_path / "e2c_t" / f"{ENV}_1").iterdir())


def test_a_folder_that_looks_like_a_pattern_keeps_all_runs(tmp_path):
    runs = [run_train(tmp_path / "logs[1]", steps=ROLLOUT) for _ in range(2)]
    assert [run.name for run in runs] == [f"{ENV}_1", f"{ENV}_2"]


def test_every_number_of_table_1_stands_in_exactly_one_line():
    assert sorted(name for _, name in table_lines()) == sorted(TABLE_1)


@pytest.mark.parametrize(("value", "name"), table_lines())
def test_the_line_has_the_number_of_the_table(value, name):
    assert yaml.safe_load(value) == TABLE_1[name]


def test_the_table_reaches_the_run():
    config = resolve("c_mappo_pe", ENV)
    assert (config["clip_range"], config["gamma"], config["gae_lambda"]) == (0.2, 0.9, 0.95)
    assert (config["ent_coef"], config["batch_size"], config["n_steps"]) == (1e-3, 4096, 80)
    assert config["multipliers_kwargs"] == {"learning_rate": 0.05, "initial": 0.0}


def test_the_five_methods_are_settings_of_one_algorithm():
    configs = {algo: resolve(algo, ENV) for algo in configuration.ALGORITHMS}
    entropy = {algo for algo, config in configs.items() if config["ent_coef"] > 0}
    individual = {a for a, config in configs.items() if config.get("cost_scope") == "individual"}
    assert entropy == {"mappo", "c_mappo_pe"}
    assert individual == {"c_mappo", "c_mappo_pe", "e2c"}
    assert [a for a, config in configs.items() if config["cost_limits"] is None] == ["mappo"]
    assert {a for a, config in configs.items() if "oem_kwargs" in config} == {"e2c", "e2c_t"}


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("algo", configuration.ALGORITHMS)
def test_every_task_has_hyperparameters_for_every_method(env_id, algo):
    config = resolve(algo, env_id)
    n_agents = len(ENV_IDS[env_id](**config.get("env_kwargs", {})).possible_agents)
    assert config["n_envs"] * config["n_steps"] * n_agents >= 4096


def test_shipped_files_have_only_keys_that_some_algorithm_reads():
    known = set().union(*(configuration.keys(algo) for algo in configuration.ALGORITHMS))
    tables = {name: read_yaml(FOLDER / f"{name}.yml") for name in ("envs", "algos", "presets")}
    entries = [read_yaml(FOLDER / "defaults.yml")]
    entries += [entry for table in tables.values() for entry in table.values()]
    assert set().union(*entries) - {"base"} <= known
    assert set(tables["algos"]) == set(configuration.ALGORITHMS)


def test_presets_combine_and_parameters_come_last():
    overrides = {"multipliers_kwargs": {"initial": 3.0}}
    config = resolve("e2c_t", ENV, ["pure", "lambda_1", "literal_dual"], overrides)
    assert config["oem_kwargs"]["psi"] is None
    assert config["multipliers_kwargs"] == {
        "learning_rate": 0.05,
        "initial": 3.0,
        "agent_scaling": False,
    }


def test_mappings_merge_without_changing_their_sources():
    first, second = {"a": {"x": 1, "y": 2}}, {"a": {"y": 3}}
    assert merge(first, second) == {"a": {"x": 1, "y": 3}}
    assert first == {"a": {"x": 1, "y": 2}}


def test_another_class_starts_with_its_own_arguments():
    old = {"estimator": "visit_count", "estimator_kwargs": {"quantization": 1}, "psi": 0.1}
    new = {"estimator": "nearest_neighbor", "estimator_kwargs": {"k": 5}}
    assert merge(old, new) == {**new, "psi": 0.1}
    assert merge(old, {"estimator": "visit_count"}) == old


def test_pid_multipliers_start_with_their_own_arguments():
    config = resolve("e2c_t", ENV, overrides={"multipliers_class": "PIDMultipliers"})
    assert "multipliers_kwargs" not in config


def test_another_policy_keeps_the_networks_of_table_1():
    policy = merge({"policy": "A", "policy_kwargs": {"net_arch": [8]}}, {"policy": "B"})
    assert policy["policy_kwargs"] == {"net_arch": [8]}


def test_yaml_is_data_only(tmp_path):
    file = tmp_path / "evil.yml"
    file.write_text("a: !!python/object/apply:os.getcwd []")
    with pytest.raises(UserError, match="cannot read"):
        read_yaml(file)


def test_numbers_without_a_dot_are_numbers(tmp_path):
    (tmp_path / "a.yml").write_text("a: 3e-4\nb: 3.0e-4\nc: -1E5\nd: e5\n")
    assert read_yaml(tmp_path / "a.yml") == {"a": 3e-4, "b": 3e-4, "c": -1e5, "d": "e5"}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("nearest_neighbor", "nearest_neighbor"),
        ("'quoted'", "quoted"),
        ("true", True),
        ("None", None),
        ("[64,64]", [64, 64]),
        ("(1,2)", [1, 2]),
        ("dict(net_arch=dict(pi=[8]))", {"net_arch": {"pi": [8]}}),
        ("__import__('os').getcwd()", "__import__('os').getcwd()"),
    ],
)
def test_values_on_the_command_line_are_read_never_executed(text, value):
    assert parse_value(text) == value


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"gama": 0.9}, "unknown hyperparameter for e2c_t 'gama'; did you mean 'gamma'"),
        ({"gamma": 1.5}, "gamma is 1.5; expected at most 1"),
        ({"n_steps": "many"}, "n_steps is 'many'; expected a whole number$"),
        ({"n_epochs": True}, "n_epochs is True"),
        ({"n_envs": -2}, "n_envs is -2; expected at least 1"),
        ({"cost_limits": [-5.0]}, "cost_limits is .* expected at least 0"),
        ({"learning_rate": "fast"}, "learning_rate is 'fast'; expected a number or a schedule"),
        ({"learning_rate": "lin_e"}, "learning_rate is 'lin_e'"),
        ({"learning_rate": "lin_inf"}, "learning_rate is 'lin_inf'"),
        ({"critic_learning_rate": "lin_-3"}, "critic_learning_rate is 'lin_-3'; .* at least 0"),
        ({"clip_range_vf": -1}, "clip_range_vf is -1; expected at least 0"),
        ({"stats_window_size": 10**33}, "stats_window_size is 1000.* expected at most"),
        ({"cost_scope": "both"}, "cost_scope is 'both'"),
        ({"normalize": "dict(norm_obs=True)"}, "normalize is .* expected true or false or a mapp"),
        ({"oem_kwargs": None}, "oem_kwargs is empty, but e2c_t explores by observation entropy"),
        ({"seed": 3}, "seed is no hyperparameter; use the flag --seed"),
    ],
)
def test_a_wrong_hyperparameter_is_named(overrides, message):
    with pytest.raises(UserError, match=message):
        resolve("e2c_t", ENV, overrides=overrides)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"multipliers_kwargs": {"lr": 1}}, "multipliers_kwargs 'lr'; known: .*learning_rate"),
        ({"multipliers_class": "PIDMultipliers", "multipliers_kwargs": {"kpp": 1}}, "mean 'kp'"),
        ({"multipliers_kwargs": {"shape": [1, 1]}}, "follows from cost_limits and cost_scope"),
        ({"multipliers_kwargs": {"initial": "high"}}, "initial is 'high'; expected a number"),
        ({"multipliers_class": "Multipliers"}, "did you mean 'PIDMultipliers'"),
        ({"oem_kwargs": {"pssi": 1}}, "unknown key in oem_kwargs 'pssi'; did you mean 'psi'"),
        ({"oem_kwargs": {"estimator": [1]}}, "oem_kwargs.estimator is .*; expected a name"),
        ({"oem_kwargs": {"estimator_kwargs": {"quant": 1}}}, "did you mean 'quantization'"),
        ({"oem_kwargs": {"estimator": "nearest_neighbor"}}, "estimator_kwargs.k is missing"),
        ({"policy_kwargs": {"net_arhc": [8]}}, "did you mean 'net_arch'"),
        ({"policy_kwargs": {"gru_hidden_size": 8}}, "unknown key in policy_kwargs 'gru_hidden_si"),
        ({"policy_kwargs": {"n_agents": 3}}, "policy_kwargs.n_agents follows from the environment"),
        ({"policy_kwargs": {"critic_lr_schedule": 1}}, "follows from critic_learning_rate"),
        ({"policy_kwargs": {"use_sde": True}}, "policy_kwargs.use_sde follows from MAPPO without"),
        ({"policy_kwargs": {"net_arch": [-3]}}, "policy_kwargs.net_arch is .* at least 1"),
        ({"policy_kwargs": {"net_arch": "big"}}, "net_arch is 'big'; expected a list of whole num"),
        ({"policy_kwargs": {"net_arch": [3.5]}}, "net_arch is .* expected a list of whole numbers"),
        ({"policy_kwargs": {"net_arch": [{"pi": [3]}]}}, "net_arch is .* expected a list of whole"),
        ({"policy_kwargs": {"optimizer_kwargs": 3}}, "expected a mapping or null"),
        ({"policy_kwargs": {"optimizer_kwargs": {"epps": 1}}}, "did you mean 'eps'"),
        ({"policy_kwargs": {"optimizer_kwargs": {"lr": 1}}}, "lr follows from learning_rate"),
        ({"normalize": {"foo": 1}}, "unknown key in normalize 'foo'; known: clip_obs"),
        ({"normalize": {"norm_obs": "maybe"}}, "norm_obs is 'maybe'; expected true or false"),
        ({"normalize": {"gamma": 0.5}}, "normalize.gamma follows from gamma"),
    ],
)
def test_a_wrong_argument_of_a_part_is_named(overrides, message):
    with pytest.raises(UserError, match=message):
        resolve("e2c_t", ENV, overrides=overrides)


def test_arguments_of_the_named_class_are_accepted():
    overrides = {
        "policy": "GruPolicy",
        "policy_kwargs": {
            "gru_hidden_size": 8,
            "net_arch": {"pi": [8], "vf": []},
            "optimizer_kwargs": {"betas": [0.9, 0.99]},
        },
        "multipliers_kwargs": {"maximum": math.inf},
        "oem_kwargs": {"estimator": "nearest_neighbor", "estimator_kwargs": {"k": 3}},
        "normalize": {"norm_reward": False},
    }
    config = resolve("e2c_t", ENV, overrides=overrides)
    assert config["oem_kwargs"]["estimator_kwargs"] == {"k": 3}


def test_multipliers_that_a_module_exports_can_be_named():
    class Mine(GradientMultipliers):
        pass

    module = SimpleNamespace(Mine=Mine, Multipliers=Multipliers, other=3)
    assert classes_in(module, Multipliers) == {"Mine": Mine}
    assert set(CLASSES["multipliers_class"]) == {"GradientMultipliers", "PIDMultipliers"}


def test_expectations_are_plain_words():
    constructed = [*(set(configuration.ALGORITHMS.values())), OEMRewardCallback, VecNormalize]
    constructed += [each for key in ("policy", "estimator") for each in CLASSES[key].values()]
    arguments = {**configuration.ZOO_KEYS}
    for each in constructed:
        arguments.update(arguments_of(each))
    taken = ("env", "venv", "device", "observation_space", "action_space", "lr_schedule")
    phrases = {arguments[key].in_words() for key in arguments if key not in taken}
    assert "a number, a schedule such as lin_3e-4 or null" in phrases
    assert "'team' or 'individual'" in phrases
    assert [each for each in phrases if re.search(r"typing|class|\[|\|", each)] == []


def test_a_key_of_another_method_is_refused_only_if_the_user_gave_it():
    assert "oem_kwargs" not in resolve("mappo", ENV, ["pure"])
    with pytest.raises(UserError, match="unknown hyperparameter for mappo 'oem_kwargs'"):
        resolve("mappo", ENV, overrides={"oem_kwargs": {"psi": 0.1}})


# ---------------------------------------------------------------------------- train


def test_a_run_folder_has_everything(trained):
    run = run_folder(trained)
    names = {path.name for path in run.iterdir()}
    assert {f"{ENV}.zip", "monitor.csv", "progress.csv", "best_model.zip"} <= names
    assert {path.name for path in (run / ENV).iterdir()} == {
        "config.yml",
        "args.yml",
        "command.txt",
    }


def test_the_saved_configuration_is_complete_and_plain(trained):
    run = run_folder(trained)
    config = yaml.safe_load((run / ENV / "config.yml").read_text())
    assert config["policy_kwargs"]["net_arch"] == [8]
    assert config["cost_limits"] == 20.0
    assert config["oem_kwargs"]["psi"] == 0.05
    assert config["env_kwargs"]["reward_at"] == "capture"
    args = yaml.safe_load((run / ENV / "args.yml").read_text())
    assert (args["algo"], args["env"], args["seed"]) == ("e2c_t", ENV, 1)
    assert args["preset"] == "headline"
    assert (run / ENV / "command.txt").read_text().startswith("python -m sb3_e2c.zoo.train --algo")


def test_the_monitor_has_one_row_for_each_episode_of_a_world(trained):
    table = pd.read_csv(run_folder(trained) / "monitor.csv", comment="#")
    assert len(table) == 4  # 2 worlds, 2 rollouts of one episode
    assert (table["l"] == 80).all()
    assert table["cost"].notna().all()


def test_the_log_has_the_multiplier(trained):
    table = pd.read_csv(run_folder(trained) / "progress.csv")
    lambdas = table[["time/total_timesteps", "train/lambda"]].dropna()
    assert lambdas["time/total_timesteps"].iloc[-1] == 2 * ROLLOUT
    assert (lambdas["train/lambda"] >= 0).all()


def test_frequencies_count_agent_steps(trained):
    run = run_folder(trained)
    checkpoints = {path.name for path in run.glob("rl_model_*.zip")}
    assert checkpoints == {f"rl_model_{k * ROLLOUT}_steps.zip" for k in (1, 2)}
    evaluations = np.load(run / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [ROLLOUT, 2 * ROLLOUT]
    assert evaluations["results"].shape == (2, 2)  # 2 evaluations of 2 world episodes


def test_the_same_seed_trains_the_same_team(trained, tmp_path):
    again = run_train(tmp_path)
    first, second = (
        E2CMAPPO.load(run / f"{ENV}.zip", device="cpu") for run in (run_folder(trained), again)
    )
    for one, other in zip(first.policy.parameters(), second.policy.parameters(), strict=True):
        assert one.equal(other)


@pytest.mark.parametrize("column", ["r", "cost"])
def test_a_learning_curve_of_damaged_numbers_is_refused(copy, column):
    path = run_folder(copy) / "monitor.csv"
    heading, *rows = path.read_text().splitlines()
    names = rows[0].split(",")
    broken = [row.split(",") for row in rows[1:]]
    for row in broken:
        row[names.index(column)] = "x"
    path.write_text("\n".join([heading, rows[0], *(",".join(row) for row in broken)]))
    with pytest.raises(UserError, match=r"monitor.csv or progress.csv is damaged"):
        plot_learning(run_folder(copy))


def test_continuing_goes_on_with_counters_and_configuration(copy):
    start = run_folder(copy) / f"{ENV}.zip"
    argv = ["--env", ENV, "-n", str(ROLLOUT), "-f", str(copy), "-i", str(start), "--seed", "2"]
    run = train.train([*argv, "--eval-freq", "-1", "--verbose", "0", "-params", "n_epochs:2"])
    assert run == run_folder(copy, 2)
    assert E2CMAPPO.load(run / f"{ENV}.zip").num_timesteps == 3 * ROLLOUT
    config = read_yaml(run / ENV / "config.yml")
    assert (config["n_envs"], config["n_epochs"]) == (2, 2)  # of the first run; of the user
    assert pd.read_csv(run / "progress.csv")["time/total_timesteps"].iloc[-1] == 3 * ROLLOUT


def test_continuing_from_numbers_alone_is_what_unpickling_would_do(copy):
    start = run_folder(copy) / f"{ENV}.zip"
    argv = ["--env", ENV, "-n", str(ROLLOUT), "-f", str(copy), "-i", str(start), "--seed", "2"]
    argv += ["--eval-freq", "-1", "--verbose", "0"]
    plain, trusted = (
        E2CMAPPO.load(train.train([*argv, *more]) / f"{ENV}.zip", device="cpu")
        for more in ([], ["--trust"])
    )
    assert plain._n_updates == trusted._n_updates > 0
    for name, tensor in trusted.policy.state_dict().items():
        assert tensor.equal(plain.policy.state_dict()[name]), name


def test_continuing_without_the_run_around_the_model_needs_the_same_networks(
    copy, tmp_path, capsys
):
    alone = tmp_path / "alone.zip"
    shutil.copy(run_folder(copy) / f"{ENV}.zip", alone)
    argv = ["--env", ENV, "-n", str(ROLLOUT), "-f", str(copy), "-i", str(alone), "--verbose", "0"]
    assert "does not fit" in refusal(capsys, train.main, argv)


@pytest.mark.parametrize("steps", [-1, 1.5, None, True, "1", [], 2**63])
def test_continuing_refuses_a_model_that_was_trained_for_no_number_of_steps(copy, capsys, steps):
    start = run_folder(copy) / f"{ENV}.zip"
    with zipfile.ZipFile(start) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["data"] = json.dumps({**json.loads(members["data"]), "num_timesteps": steps})
    with zipfile.ZipFile(start, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    argv = ["--env", ENV, "-n", str(ROLLOUT), "-f", str(copy), "-i", str(start), "--verbose", "0"]
    line = refusal(capsys, train.main, argv)
    assert f"num_timesteps is {steps}; expected a number of steps" in line


def test_a_continued_run_may_change_the_critics_learning_rate(copy):
    start = run_folder(copy) / f"{ENV}.zip"
    argv = ["--env", ENV, "-n", str(ROLLOUT), "-f", str(copy), "-i", str(start), "--verbose", "0"]
    run = train.train([*argv, "--eval-freq", "-1", "-params", "critic_learning_rate:7e-4"])
    model = E2CMAPPO.load(run / f"{ENV}.zip", device="cpu")
    assert model.policy.optimizer.param_groups[1]["lr"] == 7e-4


def test_continuing_refuses_what_would_be_another_experiment(copy, capsys):
    start = run_folder(copy) / f"{ENV}.zip"
    argv = ["--env", ENV, "-f", copy, "-i", start, "-params", "cost_limits:1.0"]
    assert "cannot become 1.0" in refusal(capsys, train.main, argv)
    assert not run_folder(copy, 2).exists()


@pytest.mark.parametrize("how", ["nothing", "params", "file", "same class"])
def test_continuing_does_not_run_what_the_file_names(copy, capsys, how):
    marker = copy / "executed"
    path = run_folder(copy) / ENV / "config.yml"
    named = {"subprocess.run": {"args": ["touch", str(marker)]}}
    if how == "same class":
        named = {
            "stable_baselines3.common.callbacks.CheckpointCallback": {"save_path": str(marker)}
        }
    path.write_text(yaml.safe_dump({**read_yaml(path), "callback": named}))
    argv = ["--env", ENV, "-f", copy, "-i", run_folder(copy) / f"{ENV}.zip", "-n", ROLLOUT]
    argv += ["--verbose", "0", "--eval-freq", "-1"]
    if how == "nothing":
        assert "which is code; say --trust" in refusal(capsys, train.main, argv)
    elif how == "file":
        (copy / "mine.yml").write_text(yaml.safe_dump({ENV: {"callback": {}}}))
        argv += ["--conf-file", copy / "mine.yml"]
        assert "callback {}" in refusal(capsys, train.main, argv)
    elif how == "params":
        assert "callback {}" in refusal(capsys, train.main, [*argv, "-params", "callback:{}"])
    else:
        word = "callback:{'stable_baselines3.common.callbacks.CheckpointCallback':{'save_freq':1}}"
        assert "save_path" in refusal(capsys, train.main, [*argv, "-params", word])
    assert not marker.exists()


def test_a_run_that_goes_on_may_use_other_threads(copy):
    argv = ["--env", ENV, "-f", str(copy), "-i", str(run_folder(copy) / f"{ENV}.zip")]
    argv += ["-n", str(ROLLOUT), "--verbose", "0", "--eval-freq", "-1"]
    run = train.train([*argv, "-params", "update_threads:2"])
    assert E2CMAPPO.load(run / f"{ENV}.zip", device="cpu").update_threads == 2


@pytest.mark.parametrize(
    "kwargs",
    [
        {"net_arch": [60_000]},
        {"net_arch": {"pi": [60_000], "vf": [8]}},
        {"features_extractor_kwargs": {"features_dim": 60_000}},
    ],
)
def test_networks_that_a_file_cannot_hold_are_refused(tmp_path, kwargs):
    (tmp_path / "model.zip").write_bytes(bytes(1000))
    with pytest.raises(UserError, match=r"has 1,000 bytes, but the networks in config\.yml 60,0"):
        check_networks({"policy_kwargs": kwargs}, tmp_path / "model.zip")


def test_networks_of_opponents_that_a_file_cannot_hold_are_refused(tmp_path):
    for name in ("model.zip", "model.adversary.zip"):
        (tmp_path / name).write_bytes(bytes(1000))
    large = {"policy_kwargs": {"net_arch": [60_000]}}
    with pytest.raises(UserError, match=r"adversary\.zip has 1,000 bytes, but the networks"):
        check_networks({"opponent_kwargs": large}, tmp_path / "model.zip")


def test_continuing_refuses_another_method(copy, capsys):
    start = run_folder(copy) / f"{ENV}.zip"
    argv = ["--algo", "e2c", "--env", ENV, "-f", copy, "-i", start]
    assert "was trained with --algo e2c_t" in refusal(capsys, train.main, argv)


def test_other_multipliers_and_estimators_can_be_named(tmp_path):
    params = ["multipliers_class:PIDMultipliers", "oem_kwargs.estimator:nearest_neighbor"]
    run = run_train(tmp_path, steps=ROLLOUT, params=[*params, "oem_kwargs.estimator_kwargs.k:3"])
    oem = read_yaml(run / ENV / "config.yml")["oem_kwargs"]
    assert oem["estimator_kwargs"] == {"k": 3}
    run_enjoy(tmp_path)


def test_normalized_observations_are_evaluated_with_the_statistics_of_training(tmp_path):
    flags = ["--save-freq", str(ROLLOUT), "--eval-freq", str(ROLLOUT), "--eval-episodes", "2"]
    run = run_train(tmp_path, *flags, params=["normalize:True"])
    for path in (f"{ENV}.zip", "best_model.zip", f"rl_model_{ROLLOUT}_steps.zip"):
        assert (run / path).with_suffix(".vecnormalize.npz").is_file()
    plain = run_enjoy(tmp_path)
    (run / f"{ENV}.vecnormalize.npz").unlink()
    assert run_enjoy(tmp_path, "--trust") == plain  # from RL-Zoo's pickle


def test_statistics_survive_without_a_pickle(tmp_path):
    env = VecNormalize(make_worlds(ENV, {}, 1, seed=0), gamma=0.5, norm_reward=False)
    env.reset()
    env.obs_rms.mean[:], env.obs_rms.var[:] = 3.0, 4.0
    save_statistics(env, tmp_path / "a.vecnormalize.npz")
    loaded = load_statistics(make_worlds(ENV, {}, 1, seed=0), tmp_path / "a.vecnormalize.npz")
    observation = np.full(env.observation_space.shape, 5.0)
    assert loaded.normalize_obs(observation) == pytest.approx((5 - 3) / 2)
    assert (loaded.gamma, loaded.norm_reward) == (0.5, False)


def test_evaluation_does_not_change_the_statistics(tmp_path):
    run = open_run(run_train(tmp_path, steps=ROLLOUT, params=["normalize:True"]), "e2c_t", ENV)
    env = make_env(run, n_worlds=1, seed=0)
    before = env.obs_rms.mean.copy()
    env.reset()
    env.step(np.ones((N, 2)))
    assert np.array_equal(env.obs_rms.mean, before)


def test_normalization_without_plain_statistics_is_refused(tmp_path, capsys):
    run = run_train(tmp_path, params=["normalize:True"])
    (run / f"{ENV}.vecnormalize.npz").unlink()
    assert "cannot read the observation statistics" in refusal(
        capsys, enjoy.main, ["--env", ENV, "-f", tmp_path]
    )


@pytest.mark.parametrize("algo", ["mappo", "c_mappo", "c_mappo_pe", "e2c"])
def test_every_method_trains_and_evaluates(tmp_path, algo):
    run_train(tmp_path, algo=algo, steps=ROLLOUT)
    result = run_enjoy(tmp_path, algo=algo)
    assert result["constrained"] == (algo != "mappo")
    assert result["cost_limits"] == [20.0]


def test_worker_processes_can_be_asked_for(tmp_path):
    run = run_train(tmp_path, "--vec-env", "subproc", steps=ROLLOUT)
    assert len(pd.read_csv(run / "monitor.csv", comment="#")) == 2


def test_tensorboard_gets_the_same_numbers(tmp_path):
    run_train(tmp_path / "logs", "-tb", str(tmp_path / "tb"), steps=ROLLOUT)
    assert list((tmp_path / "tb" / ENV / "e2c_t_1").glob("events*"))


def test_a_preset_needs_no_quotes_and_is_recorded(tmp_path):
    run = run_train(tmp_path, "--preset", "pure,lambda_1", steps=ROLLOUT)
    config = read_yaml(run / ENV / "config.yml")
    assert config["oem_kwargs"]["psi"] is None
    assert read_yaml(run / ENV / "args.yml")["preset"] == "pure,lambda_1"


def test_hyperparameters_come_from_a_file_too(tmp_path):
    conf = tmp_path / "mine.yml"
    conf.write_text("default: {gamma: 0.8}\n")
    run = run_train(tmp_path / "logs", "-conf", str(conf), steps=ROLLOUT)
    assert read_yaml(run / ENV / "config.yml")["gamma"] == 0.8


def test_networks_with_a_memory_train_and_evaluate(tmp_path):
    params = ["policy_kwargs.gru_hidden_size:8"]
    run = run_train(tmp_path, "--preset", "gru", steps=ROLLOUT, params=params)
    assert read_yaml(run / ENV / "config.yml")["policy"] == "GruPolicy"
    assert run_enjoy(tmp_path) == run_enjoy(tmp_path)


def test_the_gru_preset_keeps_the_networks_of_table_1():
    assert resolve("e2c_t", ENV, ["gru"])["policy_kwargs"]["net_arch"] == {
        "pi": [128, 128],
        "vf": [128, 128],
    }


def test_a_training_that_blows_up_is_one_line_and_keeps_what_was_saved(tmp_path, capsys):
    argv = ["--env", ENV, "-f", tmp_path, "-n", 4 * ROLLOUT, "--eval-freq", "-1", "--seed", "1"]
    params = ["learning_rate:1e30", "critic_learning_rate:1e30", "n_envs:2"]
    message = refusal(capsys, train.main, [*argv, "--device", "cpu", "-params", *params])
    assert "training stopped: " in message
    assert f"{run_folder(tmp_path)} keeps what was saved before" in message
    assert (run_folder(tmp_path) / ENV / "config.yml").is_file()


def test_help_shows_the_preset_among_rl_zoos_flags(capsys):
    with pytest.raises(SystemExit) as exit_:
        train.main(["--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert "--preset" in text
    assert "--save-freq" in text
    for flag in ("--n-trials", "-optimize", "--sampler", "--save-replay-buffer"):
        assert flag not in text


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env", "MultiRover-6-33-v0"], "did you mean 'MultiRover-6-3-v0'"),
        (["--algo", "e2c-t"], "did you mean 'e2c_t'"),
        (["--preset", "puer"], "did you mean 'pure'"),
        (["-params", "gama:0.9"], "did you mean 'gamma'"),
        (["-params", "gamma:high"], "gamma is 'high'"),
        (["-params", "gamma"], "expected key:value"),
        (["-params", "gamma:0.5", "gamma.x:3"], "found gamma.x:3, but gamma is 0.5 already"),
        (["-params", "policy_kwargs.net_arhc:[8]"], "did you mean 'net_arch'"),
        (["-params", "policy_kwargs.net_arch:dict(pii=[3])"], "expected 'pi', 'vf'"),
        (["-params", "policy_kwargs.net_arch:[10000000,10000000]"], "can't allocate memory"),
        (["-params", "policy_kwargs.activation_fn:GLU"], "shapes cannot be multiplied"),
        (["-params", "policy_kwargs.optimizer_class:LBFGS"], "LBFGS doesn't support"),
        (["-params", "normalize.norm_obs_keys:['a']"], "normalize: "),
        (["-params", "n_envs:100000000000"], "100000000000 worlds would take at least"),
        (["-params", "n_steps:10000000000"], "10000000000 steps of 60 agents would take"),
        (["--n-eval-envs", "100000000000"], "100000000000 worlds would take at least"),
        (["-params", "policy_kwargs.activation_fn:RELU"], "did you mean 'ReLU'"),
        (["-params", "policy:MlpPolcy"], "did you mean 'MlpPolicy'"),
        (["-params", "batch_size:3"], "batch_size is 3, smaller than the team of 6"),
        (["-params", "cost_limits:[1.0,2.0]"], "there are 2 cost limits"),
        (["-params", "oem_kwargs.estimator:novelty"], "novelty"),
        (["-params", "callback:no.such.Callback"], "no.such.Callback"),
        (["-params", "callback:collections.OrderedDict"], "expected callbacks of Stable"),
        (["--env-kwargs", "max_cylces:10"], "did you mean 'max_cycles'"),
        (["--env-kwargs", "max_cycles:0"], "max_cycles is 0"),
        (["--eval-env-kwargs", "max_cycles:0"], "max_cycles is 0"),
        (["--eval-env-kwargs", "n_rovers:8"], "agents of the evaluation would be"),
        (["--eval-env-kwargs", "add_id:false"], "observation_space of the evaluation would be"),
        (["-n", "-5"], "--n-timesteps is -5"),
        (["-n", "many"], "invalid int value: 'many'"),
        (["--eval-episodes", "0"], "--eval-episodes is 0"),
        (["--n-eval-envs", "-1"], "--n-eval-envs is -1"),
        (["--log-interval", "0"], "--log-interval is 0"),
        (["--seed", str(2**32)], "--seed is 4294967296"),
        (["--device", "gpu"], "--device is 'gpu'"),
        (["--device", "meta"], "--device is 'meta'; expected auto, cpu, cuda"),
        (["--device", "cuda:99"], "--device is 'cuda:99', but torch finds"),
        (["-f", ""], "--log-folder is empty"),
        (["-tb", "/proc/x"], "--tensorboard-log /proc/x: cannot write there"),
        (["--flag"], "unrecognized arguments: --flag"),
        (["-i", "missing.zip"], "-i missing.zip"),
        (["-conf", "missing.yml"], "cannot read missing.yml"),
        (["-optimize"], "-optimize"),
        (["--n-trials", "3"], "--n-trials is not available for teams"),
        (["--sampler", "random"], "--sampler is not available for teams"),
        (["--save-replay-buffer"], "--save-replay-buffer is not available for teams"),
        (["--truncate-last-trajectory", "False"], "--truncate-last-trajectory is not available"),
        (["--gym-packages", "no_such_package"], "no_such_package"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing_behind(tmp_path, capsys, flags, message):
    argv = ["--env", ENV, "-f", tmp_path / "logs", "-n", "960", "--device", "cpu", *flags]
    assert message in refusal(capsys, train.main, argv)
    assert not (tmp_path / "logs").exists()


def test_a_folder_that_cannot_be_written_is_refused(tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    for folder in (file / "logs", "/proc/x"):  # root may write to the second, and yet cannot
        assert "cannot write there" in refusal(capsys, train.main, ["--env", ENV, "-f", folder])


def test_a_gpu_must_be_there_to_be_asked_for(monkeypatch):
    monkeypatch.setattr(th.cuda, "device_count", lambda: 1)
    for device in ("auto", "cpu", "cuda", "cuda:0"):
        check_device(device)
    with pytest.raises(UserError, match="'cuda:1', but torch finds 1 such"):
        check_device("cuda:1")
    monkeypatch.setattr(th.cuda, "device_count", lambda: 0)
    with pytest.raises(UserError, match="'cuda', but torch finds 0 such"):
        check_device("cuda")


def test_seeing_whether_a_folder_can_be_written_leaves_no_trace(tmp_path):
    check_writable(tmp_path / "new" / "folder", "--log-folder")
    assert list(tmp_path.iterdir()) == []


def test_continuing_from_a_broken_file_is_refused(tmp_path, capsys):
    file = tmp_path / "model.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("data", "{}")
    argv = ["--env", ENV, "-f", tmp_path / "logs", "-i", file]
    assert "cannot continue from" in refusal(capsys, train.main, argv)
    assert not (tmp_path / "logs").exists()


# ---------------------------------------------------------------------------- enjoy


def test_enjoy_reports_the_team(trained, capsys):
    result = run_enjoy(trained)
    assert result["episodes"] == 4
    assert 0 <= result["team_return"] <= 1
    assert result["team_cost"] >= 0
    assert result["cost_limits"] == [20.0]
    assert 0 <= result["violation_rate"] <= 1
    assert result["deterministic"] is False
    assert (result["seed"], result["algo"], result["env"]) == (1_000_000, "e2c_t", ENV)
    assert Path(result["model"]) == run_folder(trained) / f"{ENV}.zip"
    text = capsys.readouterr().out
    assert "sampled actions" in text
    assert f"{ENV}.zip (--preset {result['preset']})" in text


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_a_progress_bar_changes_nothing(trained):
    assert run_enjoy(trained, "-P") == run_enjoy(trained)


@pytest.mark.parametrize(
    ("flags", "deterministic"),
    [([], False), (["--stochastic"], False), (["--deterministic"], True)],
)
def test_enjoy_repeats_itself(trained, flags, deterministic):
    first, second = (run_enjoy(trained, *flags, "--seed", "3") for _ in range(2))
    assert first == second
    assert first["deterministic"] is deterministic


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (["--load-best"], "best_model.zip"),
        (["--load-checkpoint", str(ROLLOUT)], f"rl_model_{ROLLOUT}_steps.zip"),
        (["--load-last-checkpoint"], f"rl_model_{2 * ROLLOUT}_steps.zip"),
    ],
)
def test_enjoy_loads_other_models_of_the_run(trained, flags, name):
    assert Path(run_enjoy(trained, *flags)["model"]).name == name


def test_runs_are_found_in_a_folder_with_brackets(tmp_path):
    folder = tmp_path / "logs [1]"
    for number in (1, 2):
        run_train(folder, "--save-freq", str(ROLLOUT), "-tb", str(tmp_path / "tb [1]"))
        assert run_folder(folder, number).is_dir()
    assert Path(run_enjoy(folder)["model"]).parent == run_folder(folder, 2)
    last = run_enjoy(folder, "--load-last-checkpoint")
    assert Path(last["model"]).name == f"rl_model_{2 * ROLLOUT}_steps.zip"
    logs = [path.name for path in (tmp_path / "tb [1]" / ENV).iterdir()]
    assert sorted(logs) == ["e2c_t_1", "e2c_t_2"]


def test_a_run_without_a_model_can_be_finished_or_an_older_one_taken(copy, capsys):
    shutil.copytree(run_folder(copy), run_folder(copy, 2))
    (run_folder(copy, 2) / f"{ENV}.zip").unlink()
    line = refusal(capsys, enjoy.main, ["--env", ENV, "-f", copy])
    assert f"sb3-e2c train --resume {run_folder(copy, 2)}, or choose another run" in line
    assert line.endswith("--exp-id 1")


def test_weights_alone_give_the_same_team_as_the_whole_file(trained):
    assert run_enjoy(trained) == run_enjoy(trained, "--trust")


class Payload:
    """Unpickling it creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_no_pickle_of_the_model_file_is_executed(copy, tmp_path):
    trace = tmp_path / "executed"
    payload = base64.b64encode(pickle.dumps(Payload(trace))).decode()
    poison = {":type:": "Payload", ":serialized:": payload}
    honest = run_enjoy(copy)
    model = run_folder(copy) / f"{ENV}.zip"
    rewrite(model, "data", lambda old: json.dumps({**json.loads(old), "poison": poison}).encode())
    assert run_enjoy(copy) == honest
    assert not trace.exists()
    run_enjoy(copy, "--trust")
    assert trace.exists()


def rewrite(archive, name, change):
    """Change one member of a zip file."""
    with zipfile.ZipFile(archive) as file:
        members = {each: file.read(each) for each in file.namelist()}
    members[name] = change(members[name])
    with zipfile.ZipFile(archive, "w") as file:
        for each, content in members.items():
            file.writestr(each, content)


def rewrite_weights(archive, name, change):
    """Change what torch has saved in one member of a zip file."""

    def changed(old):
        file = io.BytesIO()
        th.save(change(th.load(io.BytesIO(old))), file)
        return file.getvalue()

    rewrite(archive, name, changed)


ACTOR = "mlp_extractor.policy_net.0.weight"


@pytest.mark.parametrize(
    ("member", "change", "message"),
    [
        ("policy.pth", lambda old: [1, 2], "does not fit"),
        ("policy.pth", lambda old: {**old, ACTOR: "text"}, "does not fit"),
        ("policy.pth", lambda old: {**old, ACTOR: old[ACTOR][:1]}, "does not fit"),
        ("policy.pth", lambda old: {**old, ACTOR: old[ACTOR] * math.nan}, f"spoiled: {ACTOR} has"),
        ("policy.pth", lambda old: Payload("trace"), "holds something else than numbers"),
        ("policy.optimizer.pth", lambda old: "text", "does not fit"),
        ("policy.optimizer.pth", lambda old: {"state": 3, "param_groups": 4}, "does not fit"),
        ("multipliers.pth", lambda old: 3.0, "does not fit"),
        ("multipliers.pth", lambda old: {"values": old["values"] + math.inf}, "multipliers.values"),
    ],
)
def test_a_foreign_or_spoiled_model_is_one_short_line(copy, capsys, member, change, message):
    rewrite_weights(run_folder(copy) / f"{ENV}.zip", member, change)
    line = refusal(capsys, enjoy.main, ["--env", ENV, "-f", copy, "--device", "cpu"])
    assert message in line
    assert "weights_only" not in line
    assert len(line) < 600


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_enjoy_films_one_episode(trained, tmp_path, suffix):
    film = tmp_path / f"episode.{suffix}"
    run_enjoy(trained, "--video", str(film))
    assert film.stat().st_size > 10_000
    assert [path.name for path in tmp_path.iterdir()] == [film.name]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env", "MultiRover-6-33-v0"], "did you mean 'MultiRover-6-3-v0'"),
        (["--algo", "e2ct"], "did you mean 'e2c_t'"),
        (["--algo", "mappo"], "sb3-e2c train --algo mappo"),
        (["--exp-id", "7"], f"{ENV}_7 was not found; there are --exp-id 1; train one"),
        (["--load-checkpoint", "7"], "rl_model_7_steps.zip"),
        (["--load-checkpoint", "7"], f"checkpoints there: {ROLLOUT}, {2 * ROLLOUT}"),
        (["--n-episodes", "0"], "--n-episodes is 0"),
        (["--n-envs", "-1"], "--n-envs is -1"),
        (["--seed", "-1"], "--seed is -1"),
        (["--n-envs", "100000000000"], "100000000000 worlds would take at least"),
        (["--deterministic", "--stochastic"], "not allowed with argument --deterministic"),
        (["--load-best", "--load-last-checkpoint"], "not allowed with argument --load-best"),
        (["--load-best", "--load-checkpoint", "7"], "not allowed with argument --load-best"),
        (["--video", "film.txt"], ".gif or .mp4"),
        (["--json", "/dev/null/out.json"], "cannot write there"),
        (["--env-kwargs", "max_cylces:10"], "did you mean 'max_cycles'"),
        (["--env-kwargs", "n_rovers:8"], "does not fit"),
        (["--device", "gpu"], "--device is 'gpu'"),
        (["--device", "cuda:99"], "--device is 'cuda:99', but torch finds"),
    ],
)
def test_a_mistake_in_enjoy_is_one_line(trained, capsys, flags, message):
    argv = ["--env", ENV, "-f", trained, "--device", "cpu", "--n-episodes", "1", *flags]
    assert message in refusal(capsys, enjoy.main, argv)


@pytest.mark.parametrize(("flag", "name"), [("--json", "results"), ("--video", "film.gif")])
def test_a_folder_in_the_place_of_a_result_is_refused_before_any_work(
    trained, tmp_path, capsys, monkeypatch, flag, name
):
    monkeypatch.setattr(enjoy, "find_run", None)
    (tmp_path / name).mkdir()
    argv = ["--env", ENV, "-f", trained, flag, tmp_path / name]
    assert f"{flag} {tmp_path / name} is a folder" in refusal(capsys, enjoy.main, argv)


def test_a_missing_folder_is_one_line(tmp_path, capsys):
    assert "was not found" in refusal(capsys, enjoy.main, ["--env", ENV, "-f", tmp_path / "none"])


@pytest.mark.parametrize("content", [b"", b"no zip file", None])
def test_a_broken_model_is_one_line(copy, capsys, content):
    model = run_folder(copy) / f"{ENV}.zip"
    model.write_bytes(model.read_bytes()[:5000] if content is None else content)
    assert "no readable model" in refusal(capsys, enjoy.main, ["--env", ENV, "-f", copy])


def test_a_model_of_another_method_is_one_line(copy, capsys):
    other = run_train(copy, algo="mappo", steps=ROLLOUT)
    shutil.copy(other / f"{ENV}.zip", run_folder(copy) / f"{ENV}.zip")
    assert "does not fit" in refusal(capsys, enjoy.main, ["--env", ENV, "-f", copy])


def test_a_run_under_another_name_is_one_line(copy, capsys):
    shutil.copytree(copy / "e2c_t", copy / "e2c")
    argv = ["--algo", "e2c", "--env", ENV, "-f", copy]
    assert "was trained with --algo e2c_t, not e2c" in refusal(capsys, enjoy.main, argv)


def test_files_are_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "result.json"
    write_whole(path, "old")
    with pytest.raises(TypeError):
        write_whole(path, 3)  # type: ignore[arg-type]
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------------------- plots, demo, cli


def test_the_plot_is_a_picture_in_the_run_folder(copy):
    picture = plot_learning(run_folder(copy))
    assert picture == run_folder(copy) / "learning.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_plotting_into_a_folder_is_one_line(trained, tmp_path, capsys):
    argv = ["plot", run_folder(trained), "-o", tmp_path]
    assert f"--out {tmp_path} is a folder" in refusal(capsys, cli.main, argv)


def test_plotting_something_else_is_one_line(tmp_path, capsys):
    assert "not the folder of one run" in refusal(capsys, cli.main, ["plot", tmp_path])


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_demo_trains_evaluates_films_and_draws(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "EPISODES", 2)
    monkeypatch.setattr(demo, "WORLDS", 2)
    seeds = []

    def evaluate(model, env, *args, **kwargs):
        seeds.append(env.unwrapped._seeds[0])
        return evaluate_team(model, env, *args, **kwargs)

    monkeypatch.setattr(demo, "evaluate_team", evaluate)
    demo.main(["-n", "4800", "-f", str(tmp_path)])
    assert seeds == [1_000_000, 1_000_000]  # worlds that it was not trained in
    text = capsys.readouterr().out
    for words in ("mean reward", "mean cost", "limit on it", "lambda", "agent steps per second"):
        assert words in text
    run = run_folder(tmp_path)
    assert (run / "learning.png").is_file()
    assert (run / "episode.gif").is_file()


def test_the_console_command_suggests(capsys):
    assert "did you mean 'train'" in refusal(capsys, cli.main, ["trian"])


def test_the_console_command_lists_its_commands(capsys):
    cli.main(["--help"])
    assert "enjoy" in capsys.readouterr().out
