"""``sb3-e2c record``: what the films show, frame by frame."""

import shutil
from types import SimpleNamespace

import imageio
import imageio_ffmpeg
import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from conftest import TwoOnALine

from sb3_e2c import MAPPO, share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.zoo import cli, record, train
from sb3_e2c.zoo.console import UserError
from sb3_e2c.zoo.runs import Run

ENV = "MultiRover-6-3-v0"
STEPS = 2 * 6 * 80  # a rollout of 2 worlds of 6 rovers: one episode each
SMALL = ["n_envs:2", "n_epochs:1", "batch_size:480", "policy_kwargs.net_arch:[8]"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log folder with a run of three checkpoints, its observations normalized."""
    folder = tmp_path_factory.mktemp("logs")
    argv = ["--algo", "c_mappo", "--env", ENV, "-n", str(3 * STEPS), "-f", str(folder)]
    argv += ["--seed", "1", "--save-freq", str(STEPS), "--eval-freq", "-1", "--verbose", "0"]
    train.train([*argv, "--device", "cpu", "-params", *SMALL, "normalize:true"])
    return folder


def run_record(folder, out, *flags):
    argv = ["--algo", "c_mappo", "--env", ENV, "-f", folder, "-o", out, "--device", "cpu", *flags]
    cli.main(["record", *(str(word) for word in argv)])


def refusal(capsys, folder, out, *flags):
    with pytest.raises(SystemExit) as exit_:
        run_record(folder, out, *flags)
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("sb3-e2c: error: ")
    return lines[0]


def frames_of(path):
    with imageio.get_reader(path) as reader:
        return [np.asarray(frame)[..., :3] for frame in reader]


def team(**parameters):
    """An untrained team in one world whose picture has the color of ``start``."""
    env = share_parameters(lambda: TwoOnALine(**parameters), 1, seed=0)
    return MAPPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0), env


# ---------------------------------------------------------------------------- frames


def test_a_film_has_every_state_in_which_the_team_acts():
    model, env = team(length=4, spread=200, render_mode="rgb_array")
    assert len(list(record.film(model, env, 1, deterministic=False))) == 4


def test_the_next_episode_follows():
    model, env = team(length=4, spread=200, render_mode="rgb_array")
    colors = [int(frame[0, 0, 0]) for frame in record.film(model, env, 3, deterministic=False)]
    assert len(colors) == 12
    assert len(set(colors)) == 3
    assert colors == [color for color in colors[::4] for _ in range(4)]


def test_a_title_stands_above_the_picture():
    picture = np.full((280, 200, 3), 90, np.uint8)
    titled = record.add_title(picture, "trained for 1,000 agent steps")
    assert titled.shape == (300 + 4, 200, 3)  # twice the least size of letters, 12
    assert np.array_equal(titled[24:], picture)
    assert titled[:24].min() == 0  # black letters
    assert titled[:24].max() == 255  # on white
    other = record.add_title(picture, "trained for 2,000 agent steps")
    assert not np.array_equal(titled, other)


def test_a_film_is_written_frame_by_frame(tmp_path):
    written = []

    def frames():
        for shade in range(3):
            yield np.full((32, 32, 3), 100 * shade, np.uint8)
            written.append(shade)

    record.write_video(frames(), tmp_path / "a.gif", fps=5)
    assert written == [0, 1, 2]
    assert [frame[0, 0, 0] for frame in frames_of(tmp_path / "a.gif")] == [0, 100, 200]


def test_checkpoints_come_in_the_order_of_training(tmp_path):
    for name in ("rl_model_90_steps", "rl_model_1000_steps", "rl_model_200_steps", "best_model"):
        (tmp_path / f"{name}.zip").touch()
    (tmp_path / "rl_model_replay_buffer_5_steps.zip").touch()
    run = Run("e2c_t", ENV, tmp_path, tmp_path / "best_model.zip", {})
    found = record.checkpoints(run)
    steps = ["90", "200", "1,000"]
    assert [title for title, _ in found] == [f"trained for {n} agent steps" for n in steps]
    assert found[0][1].model_path.name == "rl_model_90_steps.zip"


# ---------------------------------------------------------------------------- the command


def test_the_film_of_a_team_has_its_episodes(trained, tmp_path, capsys):
    film = tmp_path / "team.mp4"
    run_record(trained, film, "--n-episodes", "2", "--env-kwargs", "max_cycles:10")
    assert imageio_ffmpeg.count_frames_and_secs(film) == (2 * 10, 2.0)  # rovers: 10 in a second
    assert capsys.readouterr().out == f"{film}\n"
    assert list(tmp_path.iterdir()) == [film]


def test_a_film_across_training_repeats_the_same_episode(trained, capsys, monkeypatch):
    frames = []
    monkeypatch.setattr(record, "write_video", lambda film, *_: frames.extend(film))
    run_record(trained, "a.gif", "--every-checkpoint", "--env-kwargs", "max_cycles:5")
    assert "(3 checkpoints)" in capsys.readouterr().out
    assert len(frames) == 3 * 5
    bar = len(frames[0]) - 656  # a picture of rovers has 656 rows
    first, second, third = frames[::5]
    for other in (second, third):
        assert np.array_equal(other[bar:], first[bar:])  # the same world
        assert not np.array_equal(other[:bar], first[:bar])  # another number of steps
    assert np.array_equal(frames[4][:bar], first[:bar])
    assert not np.array_equal(frames[4][bar:], frames[9][bar:])  # played by another team


def test_such_a_film_is_written_whole(trained, tmp_path):
    run_record(trained, tmp_path / "a.gif", "--every-checkpoint", "--env-kwargs", "max_cycles:2")
    frames = frames_of(tmp_path / "a.gif")
    assert len(frames) == 3 * 2
    assert len({frame.shape for frame in frames}) == 1


def test_the_same_seed_films_the_same(trained, tmp_path):
    for name in ("a", "b"):
        run_record(trained, tmp_path / f"{name}.gif", "--env-kwargs", "max_cycles:3")
    run_record(trained, tmp_path / "c.gif", "--env-kwargs", "max_cycles:3", "--seed", "5")
    a, b, c = ((tmp_path / f"{name}.gif").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_checkpoints_of_an_unfinished_run_can_be_filmed(trained, tmp_path):
    logs = shutil.copytree(trained, tmp_path / "logs")
    (logs / "c_mappo" / f"{ENV}_1" / f"{ENV}.zip").unlink()
    run_record(logs, tmp_path / "a.gif", "--every-checkpoint", "--env-kwargs", "max_cycles:2")
    assert len(frames_of(tmp_path / "a.gif")) == 3 * 2


# ---------------------------------------------------------------------------- mistakes


def unable(*args, **kwargs):
    raise RuntimeError("no\ndisplay")


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (lambda: [None], "this environment cannot be filmed: it has no rgb_array rendering"),
        (unable, "this environment cannot be filmed here: no display"),
    ],
)
def test_an_environment_without_pictures_is_said(images, message):
    model, env = team()
    env.get_images = images
    with pytest.raises(UserError, match=message):
        list(record.film(model, env, 1, deterministic=False))


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_missing_rendering_is_one_line_and_no_file(trained, tmp_path, capsys, suffix):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_e2c.envs._rover_sim.RoverSimulator.render", unable)
        line = refusal(capsys, trained, tmp_path / f"a.{suffix}")
    assert "this environment cannot be filmed here: no display" in line
    assert list(tmp_path.iterdir()) == []


def test_an_environment_that_knows_no_render_mode_is_one_line(
    trained, tmp_path, capsys, monkeypatch
):
    original = ENV_IDS[ENV]

    def without(**kwargs):
        if "render_mode" in kwargs:
            raise TypeError("unexpected keyword argument 'render_mode'")
        return original(**kwargs)

    monkeypatch.setitem(ENV_IDS, ENV, without)
    assert "render_mode" in refusal(capsys, trained, tmp_path / "a.gif")


def test_a_film_that_breaks_off_leaves_the_old_one(trained, tmp_path, capsys):
    logs = shutil.copytree(trained, tmp_path / "logs")
    broken = logs / "c_mappo" / f"{ENV}_1" / f"rl_model_{3 * STEPS}_steps.zip"
    broken.write_bytes(broken.read_bytes()[:5000])
    (tmp_path / "a.mp4").write_text("old")
    flags = ["--every-checkpoint", "--env-kwargs", "max_cycles:2"]
    line = refusal(capsys, logs, tmp_path / "a.mp4", *flags)
    assert f"rl_model_{3 * STEPS}_steps.zip is no readable model" in line
    assert (tmp_path / "a.mp4").read_text() == "old"
    assert {path.name for path in tmp_path.iterdir()} == {"a.mp4", "logs"}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--algo", "c_mapo"], "did you mean 'c_mappo'"),
        (["--exp-id", "7"], f"{ENV}_7"),
        (["--n-episodes", "0"], "--n-episodes is 0; expected at least 1"),
        (["--seed", "-1"], "--seed is -1"),
        (["--device", "gpu"], "--device is 'gpu'"),
        (["--every-checkpoint", "--load-best"], "--every-checkpoint and --load-best: give one"),
        (["--every-checkpoint", "--load-checkpoint", "960"], "--every-checkpoint and --load-check"),
        (["--out", "film.txt"], "--out is film.txt; expected a name that ends in .gif or .mp4"),
        (["--out", "/dev/null/a.gif"], "cannot write there"),
        (["--env-kwargs", "max_cylces:10"], "did you mean 'max_cycles'"),
    ],
)
def test_a_mistake_is_one_line(trained, tmp_path, capsys, flags, message):
    assert message in refusal(capsys, trained, tmp_path / "a.gif", *flags)


def test_a_run_without_checkpoints_is_one_line(trained, tmp_path, capsys):
    logs = shutil.copytree(trained, tmp_path / "logs")
    for path in (logs / "c_mappo" / f"{ENV}_1").glob("rl_model_*"):
        path.unlink()
    assert "checkpoint" in refusal(capsys, logs, tmp_path / "a.gif", "--every-checkpoint")


def test_the_help_has_an_example(capsys):
    with pytest.raises(SystemExit):
        cli.main(["record", "--help"])
    assert "sb3-e2c record --algo e2c_t" in capsys.readouterr().out


def test_frames_per_second_are_the_environments():
    def env(**metadata):
        return SimpleNamespace(get_attr=lambda name: [metadata])

    assert record._frames_per_second(env(render_fps=25)) == 25
    assert record._frames_per_second(env()) == 10
