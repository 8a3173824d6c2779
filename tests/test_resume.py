"""A run that is killed and resumed ends exactly like one that was never interrupted."""

import csv
import os
import random
import shlex
import shutil
import signal
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch as th

pytest.importorskip("rl_zoo3")

from stable_baselines3.common.save_util import load_from_zip_file

from sb3_e2c import MAPPO, OEMRewardCallback, TeamEvalCallback, share_parameters
from sb3_e2c.resume import keeps_episodes, load_training_state, training_state
from sb3_e2c.vec_env import MultiAgentVecEnv
from sb3_e2c.zoo import resume, train
from sb3_e2c.zoo.configuration import read_yaml
from sb3_e2c.zoo.resume import FOLDER, KeepPoints, ProgressFile, newest_point, read_point

ROLLOUT = 240  # 2 worlds of 6 rovers for 20 steps; episodes have 15, so that rollouts cut them
TOTAL = 5 * ROLLOUT
SMALL = ["n_envs:2", "n_epochs:2", "batch_size:120", "policy_kwargs.net_arch:[8]"]
ROVERS = ["--env", "MultiRover-6-3-v0", "-params", *SMALL, "n_steps:20", "cost_limits:0.1"]
ROVERS += ["env_kwargs.max_cycles:15", "env_kwargs.add_critic_state:true"]
PREY = ["--env", "PredatorPrey-v0", "-params", *SMALL, "n_steps:40", "env_kwargs.max_cycles:30"]
CLOCKS = {"t", "time/fps", "time/time_elapsed"}

CASES = {
    "rovers": ["--algo", "e2c_t", *ROVERS],
    "rovers, individual limits, GRU": [
        *("--algo", "e2c", "--log-interval", "2", *ROVERS, "policy:GruPolicy"),
        *("multipliers_class:PIDMultipliers", "callback:sb3_e2c.TrustRegionMonitor"),
    ],
    "predators and a learning prey": ["--algo", "e2c_t", *PREY, "normalize:True"],
    "predators and a learning prey, GRU": ["--algo", "e2c_t", *PREY, "policy:GruPolicy"],
    "predators and a random prey": ["--algo", "mappo", "--opponent", "random", *PREY],
}


def flags(folder, case="rovers"):
    own = ["-n", str(TOTAL), "-f", str(folder), "--seed", "1", "--device", "cpu", "--verbose", "0"]
    own += ["--eval-freq", "300", "--eval-episodes", "2", "--save-freq", str(2 * ROLLOUT)]
    return [*own, "--resume-every", "0", *CASES[case]]


def run_in(folder):
    (args,) = Path(folder).glob("*/*_1/*/args.yml")
    return args.parents[1]


def weights(path):
    """All that a model file holds of networks, optimizers and multipliers, by name."""
    return dict(tensors(load_from_zip_file(path, load_data=False, device="cpu")[1]))


def tensors(tree, name=""):
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from tensors(value, f"{name}/{key}")
    elif isinstance(tree, th.Tensor):
        yield name, tree.tolist()


def rows(path):
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in csv.DictReader(lines)]


def results(run):
    """Everything in a run's folder that says what was learned, without the clock."""
    found = {path.name: weights(path) for path in run.glob("*.zip")}
    found |= {name: rows(run / name) for name in ("monitor.csv", "progress.csv")}
    with np.load(run / "evaluations.npz") as file:
        return found | {name: file[name].tolist() for name in file.files}


def in_a_child(argv, kill_at=None, kill_after=None):
    """Train in a forked process, and kill it.

    :param argv: The command line
    :param kill_at: At which number of agent steps it shall kill itself
    :param kill_after: After how many seconds it shall be killed
    :return: Its exit status, -9 if it was killed
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
        pid = os.fork()
    if pid == 0:
        try:
            if kill_at is not None:
                KeepPoints._on_step = lambda self: die(self.num_timesteps >= kill_at)
            train.main(argv)
        finally:
            os._exit(0)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def die(now):
    if now:
        os.kill(os.getpid(), signal.SIGKILL)
    return True


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Results of uninterrupted runs by case, each trained when first asked for."""
    found = {}

    def of(case):
        if case not in found:
            found[case] = results(train.train(flags(tmp_path_factory.mktemp("straight"), case)))
        return found[case]

    return of


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A run that was killed in its third rollout."""
    folder = tmp_path_factory.mktemp("killed")
    assert in_a_child(flags(folder), kill_at=2 * ROLLOUT + 100) == -signal.SIGKILL
    return run_in(folder)


@pytest.fixture
def copy(killed, tmp_path):
    """The killed run, for a test that goes on with it."""
    return shutil.copytree(killed, tmp_path / "e2c_t" / killed.name)


def refusal(capsys, argv):
    """The one line that the command writes to stderr before it exits with status 2."""
    with pytest.raises(SystemExit) as exit_:
        train.main([str(word) for word in argv])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


# ---------------------------------------------------------------------------- killed and resumed


@pytest.mark.parametrize("case", CASES)
def test_a_killed_and_resumed_run_ends_bit_for_bit_like_an_uninterrupted_one(
    case, tmp_path, straight
):
    assert in_a_child(flags(tmp_path, case), kill_at=ROLLOUT + 100) == -signal.SIGKILL
    argv = ["--resume", str(run_in(tmp_path))]
    assert in_a_child(argv, kill_at=4 * ROLLOUT + 50) == -signal.SIGKILL
    assert results(train.train(argv)) == straight(case)


def test_kills_at_random_moments_lose_nothing(tmp_path, straight):
    rng = random.Random(0)
    status, argv = None, flags(tmp_path)
    for _ in range(4):
        status = in_a_child(argv, kill_after=rng.uniform(0.3, 0.8))
        if list(tmp_path.glob(f"*/*/{FOLDER}/*.point")):
            argv = ["--resume", str(run_in(tmp_path))]
        else:  # killed before training began
            shutil.rmtree(tmp_path, ignore_errors=True)
    assert status is not None
    assert results(train.train(argv)) == straight("rovers")


def test_a_run_that_continues_another_is_resumed_too(tmp_path):
    first = train.train(flags(tmp_path / "first"))
    argv = ["-i", str(first / "MultiRover-6-3-v0.zip")]
    whole = train.train([*flags(tmp_path / "whole"), *argv])
    killed = [*flags(tmp_path / "killed"), *argv]
    assert in_a_child(killed, kill_at=TOTAL + 2 * ROLLOUT + 50) == -signal.SIGKILL
    run = run_in(tmp_path / "killed")
    assert results(train.train(["--resume", str(run)])) == results(whole)


def test_more_steps_can_be_asked_for(tmp_path):
    constant = ["learning_rate:0.001", "critic_learning_rate:0.001"]  # no schedule
    whole = train.train([*flags(tmp_path / "whole"), *constant])
    half = [*flags(tmp_path / "half"), *constant]
    run = train.train([*half[:1], str(TOTAL // 2), *half[2:]])
    train.train(["--resume", str(run), "-n", str(TOTAL)])
    assert results(run) == results(whole)


def test_rows_after_the_point_are_cut_off(copy, straight):
    assert len(rows(copy / "monitor.csv")) >= 4  # 2 worlds, at least 40 steps, episodes of 15
    for name in ("monitor.csv", "progress.csv"):
        with (copy / name).open("a") as file:
            file.write("1,2,3,4\n5,6")
    (copy / ".best_model.zip.abcd_123").write_bytes(b"killed while it was written")
    train.train(["--resume", str(copy)])
    assert results(copy) == straight("rovers")
    assert list(copy.glob(".*")) == []


def test_a_damaged_point_falls_back_to_the_one_before_it(copy, straight, capsys):
    newest, before = sorted((copy / FOLDER).glob("*.point"), reverse=True)
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    train.train(["--resume", str(copy)])
    assert f"{newest} is damaged (its checksum is wrong): going back" in capsys.readouterr().out
    assert results(copy) == straight("rovers")
    assert not before.exists()


@pytest.mark.parametrize("cut", [0, 10, 64, 65, 70, -1])
def test_every_cut_of_a_point_is_seen(killed, tmp_path, cut):
    path = tmp_path / "cut.point"
    path.write_bytes(next((killed / FOLDER).glob("*.point")).read_bytes()[:cut])
    with pytest.raises(ValueError, match="checksum"):
        read_point(path)


# ---------------------------------------------------------------------------- stopped


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_says_how_to_go_on(tmp_path, straight, monkeypatch, capsys, number):
    def stop(self):
        if self.num_timesteps == 3 * ROLLOUT + 120:
            os.kill(os.getpid(), number)
        return True

    monkeypatch.setattr(KeepPoints, "_on_step", stop)
    argv = flags(tmp_path)
    argv[argv.index("--resume-every") + 1] = "1000"  # only what the signal makes it write
    monkeypatch.setattr(resume, "_KEEP_EVERY", 0.0)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as exit_:
        train.main(argv)
    assert exit_.value.code == 128 + number
    assert signal.getsignal(signal.SIGTERM) == before
    monkeypatch.undo()
    run = run_in(tmp_path)
    printed = capsys.readouterr().out
    assert f"Interrupted at {3 * ROLLOUT + 120} agent steps" in printed
    point = newest_point(run)
    assert point is not None
    assert point.steps == 3 * ROLLOUT
    assert (run / "MultiRover-6-3-v0.zip").exists()
    train.main(shlex.split(printed.split("Go on with: sb3-e2c train ")[1]))
    assert results(run) == straight("rovers")


def test_a_finished_run_has_nothing_left_to_do(tmp_path, capsys):
    run = train.train(flags(tmp_path))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert train.train(["--resume", str(run)]) == run
    assert f"nothing to do, {TOTAL:,} agent steps are done" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


# ---------------------------------------------------------------------------- refused, doubted


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--algo", "mappo"], "--algo e2c_t, and --algo mappo contradicts it"),
        (["--env", "KeepAway-v0"], "--env MultiRover-6-3-v0, and --env KeepAway-v0"),
        (["-params", "n_epochs:3"], "contradicts it; leave it away, or start a new run"),
        (["--resume-every", "-1"], "--resume-every is -1.0"),
    ],
)
def test_a_contradiction_is_one_line(killed, capsys, argv, message):
    assert message in refusal(capsys, ["--resume", killed, *argv])


def test_a_folder_without_a_run_is_one_line(tmp_path, capsys):
    assert "no run of train is there" in refusal(capsys, ["--resume", tmp_path])


def test_a_run_without_any_whole_point_is_one_line(copy, capsys):
    for path in (copy / FOLDER).glob("*.point"):
        path.write_bytes(b"")
    assert "there is no other resume point: train anew" in refusal(capsys, ["--resume", copy])
    shutil.rmtree(copy / FOLDER)
    assert "has no resume point" in refusal(capsys, ["--resume", copy])


def test_two_processes_cannot_train_the_same_run(copy, capsys):
    other = resume.Resumable(copy, every=60, resumes=True)
    other.open({})
    assert "being trained by another process" in refusal(capsys, ["--resume", copy])
    other.close()


def test_flags_of_the_run_may_be_repeated(copy, straight):
    train.train(["--resume", str(copy), "--algo", "e2c_t", "--env", "MultiRover-6-3-v0"])
    assert results(copy) == straight("rovers")


def test_what_spoils_exactness_is_said(copy, capsys, monkeypatch):
    config = copy / "MultiRover-6-3-v0" / "config.yml"
    config.write_text(config.read_text().replace("n_epochs: 2", "n_epochs: 1"))
    monkeypatch.setattr(resume, "_versions", lambda: {"torch": "0.0"})
    train.train(["--resume", str(copy)])
    printed = capsys.readouterr().out
    assert "config.yml was changed (n_epochs)" in printed
    assert "torch was" in printed
    assert "and is now 0.0" in printed
    assert "bit for bit" not in printed
    assert read_yaml(config)["n_epochs"] == 1


def test_worlds_in_processes_begin_new_episodes(tmp_path, capsys, monkeypatch):
    argv = [*flags(tmp_path), "--vec-env", "subproc"]
    assert in_a_child(argv, kill_at=4 * ROLLOUT + 50) == -signal.SIGKILL
    seeds = {}  # of the first world, the last that was given
    seed = MultiAgentVecEnv.seed
    monkeypatch.setattr(
        MultiAgentVecEnv, "seed", lambda env, n: (seeds.update({env.n_worlds: n}), seed(env, n))[1]
    )
    run = train.train(["--resume", str(run_in(tmp_path))])
    assert "begin new episodes" in capsys.readouterr().out
    assert seeds[2] == 1 + 4 * ROLLOUT  # not those of the seed again
    assert rows(run / "progress.csv")[-1]["time/total_timesteps"] == str(TOTAL)


def test_a_run_beyond_its_new_end_is_not_called_done(tmp_path, capsys):
    assert in_a_child(flags(tmp_path), kill_at=4 * ROLLOUT + 50) == -signal.SIGKILL
    with pytest.raises(SystemExit):
        train.main(["--resume", str(run_in(tmp_path)), "-n", str(2 * ROLLOUT)])
    error = capsys.readouterr().err
    assert f"{4 * ROLLOUT} agent steps are done, more than -n {2 * ROLLOUT}, and the mo" in error


def test_an_error_of_a_callback_leaves_a_point_to_go_on_from(tmp_path, monkeypatch):
    def fail(self):
        if self.num_timesteps == 3 * ROLLOUT + 120:
            raise KeyError("mine")
        return True

    monkeypatch.setattr(KeepPoints, "_on_step", fail)
    monkeypatch.setattr(resume, "_KEEP_EVERY", 0.0)
    argv = flags(tmp_path)
    argv[argv.index("--resume-every") + 1] = "1000"
    with pytest.raises(KeyError, match="mine"):
        train.train(argv)
    assert newest_point(run_in(tmp_path)).steps == 3 * ROLLOUT


# ---------------------------------------------------------------------------- the parts


def test_a_log_goes_on_with_the_rows_that_are_kept(tmp_path):
    path = tmp_path / "progress.csv"
    log = ProgressFile(path)
    none = {"a": None, "b": None, "c": None}
    log.write({"b": 1, "a": 2}, none)
    log.write({"c": 'say "hi"'}, none)
    log.write({"a": 3.5}, none)
    log.close()
    assert path.read_text() == 'a,b,c\n2,1,\n,,"say ""hi"""\n3.5,,\n'
    log = ProgressFile(path, n_rows=2)
    log.write({"a": 4}, none)
    log.close()
    assert path.read_text() == 'a,b,c\n2,1,\n,,"say ""hi"""\n4,,\n'


class Counter(OEMRewardCallback):
    """A user's callback with a state, a setting and links of its own."""

    def __init__(self, step):
        super().__init__("visit_count", {"empty": 0.0})
        self.step, self.count, self.by_world = step, 0, {}

    def _on_step(self):
        self.count += self.step
        self.by_world[0] = self.count
        self.link, self.file = self.training_env, open(os.devnull)  # noqa: SIM115
        self.file.close()
        return super()._on_step()


class AtRollout(Counter):
    """Keeps, or loads, the state of a training at the beginning of its n-th rollout."""

    def __init__(self, step, number, state=None):
        super().__init__(step)
        self.number, self.state, self.rollouts = number, state, 0

    def _on_rollout_start(self):
        super()._on_rollout_start()
        if self.state is None and self.rollouts == self.number:
            self.kept = training_state(self.model, self)
        elif self.state is not None and self.rollouts == 0:
            load_training_state(self.model, self, self.state)
        self.rollouts += 1


@pytest.fixture(name="team")
def fixture_team(two_on_a_line):
    def make(**kwargs):
        env = share_parameters(lambda: two_on_a_line(spread=3, **kwargs), n_worlds=2)
        model = MAPPO("MlpPolicy", env, n_steps=6, batch_size=8, cost_limits=1.0, seed=0)
        return model

    return make


def test_callbacks_of_users_are_kept_except_their_settings(team):
    model, first = team(), AtRollout(step=1, number=2)
    model.learn(4 * 24, first)
    other, second = team(), AtRollout(step=100, number=0, state=first.kept)
    other.learn(4 * 24, second)
    assert first.count == 4 * 6
    assert second.count == 2 * 6 + 2 * 600  # 2 rollouts of 6 steps before; a setting is not kept
    assert second.by_world == {0: second.count}
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, other.policy.state_dict()[name]), name


def test_a_state_does_not_fit_a_training_with_other_parts(team):
    model, first = team(), AtRollout(step=1, number=0)
    model.learn(24, first)
    evaluation = TeamEvalCallback(team().env)
    second = AtRollout(step=1, number=0, state=first.kept)
    second.inner = evaluation
    with pytest.raises(ValueError, match="exist in one of them only"):
        team().learn(24, second)


def test_only_simulators_keep_their_episodes(two_on_a_line):
    assert keeps_episodes(share_parameters(two_on_a_line, n_worlds=2))
    assert not keeps_episodes(share_parameters(two_on_a_line, n_worlds=2, backend="supersuit"))
