"""The command line on tasks in which somebody plays against the team."""

import json
import shutil

import numpy as np
import pytest
import yaml
from stable_baselines3.common.save_util import load_from_zip_file

pytest.importorskip("rl_zoo3")
pytest.importorskip("mpe2")

from sb3_e2c.zoo import enjoy, train
from sb3_e2c.zoo.build import load_weights
from sb3_e2c.zoo.configuration import resolve
from sb3_e2c.zoo.console import UserError
from sb3_e2c.zoo.runs import find_run, load_model, make_env

ENV = "PredatorPrey-v0"
ROLLOUT = 2 * 3 * 10  # agent steps of 2 worlds with 3 predators
SMALL = ["n_envs:2", "n_steps:10", "n_epochs:1", "batch_size:60", "policy_kwargs.net_arch:[8]"]


def run_train(folder, *flags, algo="e2c_t", env=ENV, steps=2 * ROLLOUT):
    argv = ["--algo", algo, "--env", env, "-n", str(steps), "-f", str(folder), "--seed", "1"]
    argv += ["--eval-freq", "-1", "--device", "cpu", "--verbose", "0", *flags]
    return train.train([*argv, "--env-kwargs", "max_cycles:10", "-params", *SMALL])


def run_enjoy(folder, *flags, algo="e2c_t"):
    out = folder / "result.json"
    argv = ["--algo", algo, "--env", ENV, "-f", str(folder), "--device", "cpu", "--n-envs", "2"]
    enjoy.main([*argv, "--n-episodes", "4", "--json", str(out), *flags])
    return json.loads(out.read_text())


def refusal(capsys, main, argv):
    with pytest.raises(SystemExit) as exit_:
        main([str(word) for word in argv])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    flags = ["--save-freq", str(ROLLOUT), "--eval-freq", str(ROLLOUT), "--eval-episodes", "2"]
    run_train(folder, *flags)
    return folder


@pytest.fixture
def copy(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "logs")


def test_the_adversary_lies_beside_every_saved_model(trained):
    files = {path.name for path in (trained / "e2c_t" / f"{ENV}_1").glob("*.zip")}
    models = {ENV, "best_model", f"rl_model_{ROLLOUT}_steps", f"rl_model_{2 * ROLLOUT}_steps"}
    assert files == {f"{name}{end}" for name in models for end in (".zip", ".adversary.zip")}


def test_the_adversary_s_loss_and_return_are_logged(trained):
    header = (trained / "e2c_t" / f"{ENV}_1" / "progress.csv").read_text().splitlines()[0]
    assert {"adversary/train/loss", "adversary/rollout/ep_rew_mean"} <= set(header.split(","))


@pytest.mark.parametrize("algo", ["mappo", "c_mappo", "c_mappo_pe", "e2c"])
def test_the_adversary_has_the_same_settings_under_every_method(tmp_path, algo):
    folder = run_train(tmp_path, algo=algo, steps=ROLLOUT)
    config = yaml.safe_load((folder / ENV / "config.yml").read_text())
    assert config["opponent_kwargs"] == {"ent_coef": 1e-3}


def test_opponents_are_reported_side_by_side(trained, capsys):
    other = trained / "e2c_t" / f"{ENV}_1" / "best_model.adversary.zip"
    result = run_enjoy(trained, "--opponent", "own", "random", str(other))
    assert [each["opponent"] for each in result["against"]] == ["own", "random", str(other)]
    assert result["opponent"] == "own"
    assert result["team_return"] == result["against"][0]["team_return"]
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows[-4:]] == ["opponent", "own", "random", str(other)]


def test_each_opponent_meets_the_same_worlds(trained):
    twice = run_enjoy(trained, "--opponent", "random", "own", "random")["against"]
    assert twice[0] == twice[2]


def test_enjoy_without_the_adversary_is_refused_unless_another_is_named(copy, capsys):
    path = copy / "e2c_t" / f"{ENV}_1" / f"{ENV}.adversary.zip"
    path.rename(copy / "prey.zip")
    argv = ["--algo", "e2c_t", "--env", ENV, "-f", copy, "--n-episodes", "2"]
    assert "--opponent random" in refusal(capsys, enjoy.main, argv)
    for opponent in ("random", str(copy / "prey.zip")):
        assert run_enjoy(copy, "--opponent", opponent)["opponent"] == opponent


def test_a_file_that_is_no_adversary_is_one_line(trained, capsys):
    team = trained / "e2c_t" / f"{ENV}_1" / f"{ENV}.zip"
    argv = ["--algo", "e2c_t", "--env", ENV, "-f", trained, "--opponent", team]
    assert "does not fit" in refusal(capsys, enjoy.main, argv)


def weights(model):
    return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()])


def test_a_fixed_adversary_learns_no_more(trained, tmp_path):
    first = trained / "e2c_t" / f"{ENV}_1" / f"{ENV}.adversary.zip"
    folder = run_train(tmp_path, "--opponent", str(first))
    second = folder / f"{ENV}.adversary.zip"
    argv = {"algo": "e2c_t", "env": ENV, "folder": str(tmp_path), "exp_id": 0}
    which = dict.fromkeys(("load_best", "load_checkpoint", "load_last_checkpoint"))
    run = find_run(type("Args", (), {**argv, **which})())
    env = make_env(run, 1, 0)
    model = load_model(run, env, opponent="random")
    before, after = (model.new_opponent(env.unwrapped) for _ in range(2))
    load_weights(before, first)
    load_weights(after, second)
    np.testing.assert_array_equal(weights(before), weights(after))


def test_against_random_actions_no_adversary_is_saved(tmp_path):
    folder = run_train(tmp_path, "--opponent", "random", steps=ROLLOUT)
    assert [path.name for path in folder.glob("*.zip")] == [f"{ENV}.zip"]
    assert run_enjoy(tmp_path, "--opponent", "random")["episodes"] == 4


def test_continuing_brings_the_adversary_along(trained, tmp_path):
    model = trained / "e2c_t" / f"{ENV}_1" / f"{ENV}.zip"
    folder = run_train(tmp_path, "-i", str(model), steps=ROLLOUT)
    assert (folder / f"{ENV}.adversary.zip").exists()


def test_continuing_from_numbers_alone_is_what_unpickling_would_do(trained, tmp_path):
    model = trained / "e2c_t" / f"{ENV}_1" / f"{ENV}.zip"
    for_both = ["-i", str(model), "--seed", "2", "--eval-freq", "-1"]
    folders = [
        run_train(tmp_path / name, *for_both, *more, steps=ROLLOUT)
        for name, more in (("plain", []), ("trusted", ["--trust"]))
    ]
    for name in (f"{ENV}.zip", f"{ENV}.adversary.zip"):
        plain, trusted = (load_from_zip_file(each / name, device="cpu") for each in folders)
        assert plain[0]["_n_updates"] == trusted[0]["_n_updates"] > 0
        assert plain[0]["num_timesteps"] == trusted[0]["num_timesteps"]
        for key, tensor in trusted[1]["policy"].items():
            assert tensor.equal(plain[1]["policy"][key]), (name, key)


def test_opponents_are_refused_where_nobody_plays_against_the_team(tmp_path, capsys):
    argv = ["--algo", "e2c_t", "--env", "MultiRover-6-3-v0", "-n", "1", "-f", tmp_path]
    line = refusal(capsys, train.main, [*argv, "--opponent", "random", "--verbose", "0"])
    assert "nobody plays against" in line
    line = refusal(capsys, train.main, [*argv, "--opponent", "rando"])
    assert "expected own, random, or the .zip file" in line


def test_arguments_that_follow_from_the_team_s_are_refused():
    with pytest.raises(UserError, match=r"opponent_kwargs.n_steps follows from the team's"):
        resolve("e2c_t", ENV, overrides={"opponent_kwargs": {"n_steps": 3}})


def test_the_film_shows_both_sides(trained, tmp_path):
    film = tmp_path / "film.gif"
    run_enjoy(trained, "--video", str(film))
    assert film.read_bytes()[:3] == b"GIF"
