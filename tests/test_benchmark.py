"""Suites of experiments: what is run, by whom, what is left, and what happens when it breaks."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rl_zoo3")

from filelock import FileLock

from sb3_e2c.envs import ENV_IDS
from sb3_e2c.zoo import benchmark, cli, jobs, pools
from sb3_e2c.zoo.configuration import team_limits
from sb3_e2c.zoo.console import UserError
from sb3_e2c.zoo.jobs import BUSY, INTERRUPTED, train_flags
from sb3_e2c.zoo.results import Place, find_results, learning_curve, read_json, write_json
from sb3_e2c.zoo.suite import Job, find_suite, read_suite, suite_names, suite_text

ENV = "MultiRover-6-3-v0"
ROLLOUT = 2 * 6 * 80  # agent steps of two worlds of six rovers
TINY = f"""
seeds: 2
window: 2
eval_episodes: 2
n_timesteps: {2 * ROLLOUT}
methods:
  small:
    algo: e2c_t
    name: E2C (T)
    params: {{n_envs: 2, n_epochs: 1, batch_size: 480, policy_kwargs: {{net_arch: [8]}}}}
  mappo: {{}}
experiments:
  one: {{envs: [{ENV}], methods: [small, mappo], baselines: [mappo]}}
"""


@pytest.fixture
def suite_file(tmp_path):
    path = tmp_path / "tiny.yml"
    path.write_text(TINY)
    return path


@pytest.fixture
def place(suite_file, tmp_path):
    """The first job of the suite."""
    return Place(tmp_path / "out", read_suite(suite_file).jobs()[0])


def refusal(capsys, argv):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["benchmark", *map(str, argv)])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


# ---------------------------------------------------------------------------- suites


def test_a_suite_is_run_seed_by_seed(suite_file):
    names = [job.name for job in read_suite(suite_file).jobs()]
    assert names == [f"{ENV}/{label}/seed_{s}" for s in (0, 1) for label in ("small", "mappo")]


def test_a_run_that_two_experiments_share_is_one_job(suite_file):
    suite_file.write_text(TINY + f"  two: {{envs: [{ENV}], methods: [small]}}\n")
    assert len(read_suite(suite_file).jobs()) == 4


def test_only_chooses_by_experiment_environment_method_and_seed(suite_file):
    suite = read_suite(suite_file)
    assert [job.name for job in suite.jobs(only=["one/*/mappo/seed_1"])] == [f"{ENV}/mappo/seed_1"]
    assert {job.seed for job in suite.jobs(seeds=[7])} == {7}
    with pytest.raises(UserError, match="matches no"):
        suite.jobs(only=["two/*"])


def test_a_job_survives_its_way_to_another_process(place):
    settings = json.loads(json.dumps(place.job.settings()))
    assert Job.from_settings(settings) == place.job


def test_seeds_may_be_ranges():
    assert benchmark.parse_seeds(["3", "5-7", "3"]) == [3, 5, 6, 7]
    for word in ("x", "-1", "5-3", "0-9999999999", str(2**32)):
        with pytest.raises(UserError, match="--seeds"):
            benchmark.parse_seeds([word])


@pytest.mark.parametrize("name", suite_names())
def test_shipped_suites_ask_for_nothing_that_the_zoo_refuses(name):
    for job in read_suite(find_suite(name)).jobs(seeds=[0]):
        if job.env in ENV_IDS:
            job.configuration()


# Figures of the paper: environments, team limits (Sec. 5.2; none are given for particles), methods
PAPER = {
    "fig3": (
        {"6-3": 20, "6-4": 20, "8-3": 40, "8-4": 30, "10-4": 75},
        {"mappo", "e2c", "e2c_t"},
    ),
    "fig4": ({"6-2": 2, "6-4": 20}, {"c_mappo", "c_mappo_pe", "e2c"}),
    "fig5": (
        dict.fromkeys(("PhysicalDeception", "KeepAway", "PredatorPrey")),
        {"c_mappo", "c_mappo_pe", "e2c", "e2c_t"},
    ),
    "fig6": (
        {"SafeAnt-2x4": 5, "SafeHalfCheetah-2x3": 20},
        {"c_mappo", "c_mappo_pe", "e2c_t"},
    ),
}


@pytest.mark.parametrize("key", PAPER)
def test_the_suite_of_the_paper_has_the_experiments_of_the_figure(key):
    suite = read_suite(find_suite("paper"))
    (experiment,) = (each for each in suite.experiments if each.id == key)
    limits, algos = PAPER[key]
    wanted = {f"MultiRover-{k}-v0" if key in ("fig3", "fig4") else f"{k}-v0" for k in limits}
    assert set(experiment.envs) == wanted
    assert {suite.methods[label].algo for label in experiment.methods} == algos
    assert suite.seeds == tuple(range(10))
    assert suite.window == 100
    for env, limit in zip(experiment.envs, limits.values(), strict=True):
        if env in ENV_IDS and limit is not None:
            assert team_limits(env, {}) == [limit]


def test_the_paper_without_memory_is_the_paper_with_other_networks():
    paper, mlp = (read_suite(find_suite(name)) for name in ("paper", "paper_mlp"))
    assert mlp.experiments == paper.experiments
    assert paper.methods["c_mappo-literal"].preset == "gru,lambda_1,literal_dual"
    assert mlp.methods["c_mappo-literal"].preset == "headline,lambda_1,literal_dual"


def test_a_suite_may_have_the_name_of_the_one_that_it_builds_on(tmp_path):
    (tmp_path / "smoke.yml").write_text("base: smoke\nseeds: 7\n")
    assert len(read_suite(tmp_path / "smoke.yml").seeds) == 7


def test_results_keep_a_suite_that_needs_no_other_file(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("base: smoke\nseeds: 7\n")
    kept = tmp_path / "kept.yml"
    kept.write_text(suite_text(path))
    assert "base:" not in kept.read_text()
    assert read_suite(kept, "mine") == read_suite(path)
    assert read_suite(path).seeds == tuple(range(7))
    assert read_suite(path).experiments == read_suite(find_suite("smoke")).experiments


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seeds: 2", "sedes: 2", "did you mean 'seeds'"),
        ("seeds: 2", "base: papr", "did you mean 'paper'"),
        ("seeds: 2", "seeds: [0, -1]", "expected how many, or a list"),
        ("window: 2", "window: 0", "expected at least 1"),
        ("window: 2", "window: two", "expected int"),
        ("algo: e2c_t", "algo: e2c_x", "did you mean 'e2c_t'"),
        ("name: E2C (T)", "preset: pur", "did you mean 'pure'"),
        ("methods: [small, mappo]", "methods: [smal]", "did you mean 'small'"),
        ("baselines: [mappo]", "baselines: [e2c]", "unknown method 'e2c'"),
        (f"envs: [{ENV}]", "envs: []", "envs is missing or empty"),
        (f"envs: [{ENV}]", "envs: [../x]", "letters, digits"),
        ("  mappo: {}", "  ../mappo: {}", "letters, digits"),
        ("methods:\n", "methods: 3\n#", "expected dict"),
    ],
)
def test_a_mistake_in_a_suite_is_one_line(suite_file, capsys, old, new, words):
    assert old in TINY
    text = TINY.replace(old, new)
    suite_file.write_text(text if new != "methods: 3\n#" else "methods: 3\nexperiments: {}\n")
    assert words in refusal(capsys, ["--suite", suite_file, "-f", suite_file.parent])


def test_two_lengths_of_one_run_are_a_mistake(suite_file):
    more = f"  two: {{envs: [{ENV}], methods: [small], n_timesteps: 5}}\n"
    suite_file.write_text(TINY + more)
    with pytest.raises(UserError, match="different n_timesteps"):
        read_suite(suite_file)


def test_other_mistakes_are_one_line(suite_file, tmp_path, capsys):
    assert "did you mean 'smoke'" in refusal(capsys, ["--suite", "smok", "-f", tmp_path])
    assert "cannot read" in refusal(capsys, ["--suite", "missing.yml", "-f", tmp_path])
    flags = ["--suite", suite_file, "-f", tmp_path]
    assert "--jobs is 0" in refusal(capsys, [*flags, "--jobs", "0"])
    assert "cannot write there" in refusal(capsys, ["--suite", suite_file, "-f", suite_file / "x"])


# ---------------------------------------------------------------------------- curves


def tables(lengths=(80, 80, 80, 80, 80), n_agents=2):
    n = len(lengths)
    episodes = pd.DataFrame(
        {
            "r": np.arange(n, dtype=float),
            "l": lengths,
            "t": np.arange(n) + 0.5,
            "cost": [0.0, 4, 2, 2, 9],
        }
    )
    env_steps = np.cumsum(lengths)
    progress = pd.DataFrame(
        {
            "time/env_steps": env_steps,
            "time/total_timesteps": n_agents * env_steps,
            "train/lambda": [np.nan, 0.1, 0.2, 0.3, 0.4],
        }
    )
    return episodes, progress


def test_a_row_of_the_curve_is_the_mean_of_a_window_of_episodes():
    curve = learning_curve(*tables(), limits=[3.0], window=2)
    assert curve["episodes"].tolist() == [2, 4, 5]
    assert curve["agent_steps"].tolist() == [320, 640, 800]
    assert curve["seconds"].tolist() == [1.5, 3.5, 4.5]
    assert curve["reward"].tolist() == [0.5, 2.5, 4.0]
    assert curve["cost"].tolist() == [2.0, 2.0, 9.0]
    assert curve["limit"].tolist() == [3.0, 3.0, 3.0]
    assert curve["violation"].tolist() == [0.5, 0.0, 1.0]
    assert curve["lambda"].tolist() == [0.1, 0.3, 0.4]


def test_each_constraint_has_its_columns():
    episodes, progress = tables()
    episodes = episodes.rename(columns={"cost": "cost_0"}).assign(cost_1=1.0)
    curve = learning_curve(episodes, progress, limits=[10.0, 0.5], window=5)
    assert curve[["limit_0", "limit_1", "violation"]].iloc[0].tolist() == [10.0, 0.5, 1.0]


# ---------------------------------------------------------------------------- one job


def test_settings_become_flags_of_train(place):
    flags = train_flags(place)
    assert flags[flags.index("-n") + 1] == str(2 * ROLLOUT)
    params = flags[flags.index("-params") + 1 :]
    assert "policy_kwargs.net_arch:[8]" in params
    assert "n_envs:2" in params


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_result_names_the_commit_of_a_checkout(tmp_path):
    def git(*words):
        who = ("-c", "user.name=me", "-c", "user.email=me@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True)

    assert jobs._commit(tmp_path) is None
    git("init")
    assert jobs._commit(tmp_path) is None  # nothing committed
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-m", "first")
    commit = jobs._commit(tmp_path)
    assert re.fullmatch("[0-9a-f]{12}", commit)
    (tmp_path / "file").write_text("2")
    assert jobs._commit(tmp_path) == f"{commit}-dirty"


def test_a_job_leaves_small_files_and_is_not_repeated(place, monkeypatch):
    assert jobs.run_job(place) == 0
    curve = pd.read_csv(place.results / "curve.csv")
    assert curve["episodes"].tolist() == [2, 4]
    assert curve["agent_steps"].tolist() == [ROLLOUT, 2 * ROLLOUT]
    assert set(curve) >= {"seconds", "reward", "cost", "limit", "violation", "lambda"}
    evaluation = read_json(place.results / "evaluation.json")
    assert evaluation["sampled"]["episodes"] == 2
    assert [evaluation[mode]["deterministic"] for mode in jobs.MODES] == [False, True]
    record = read_json(place.done)
    assert record["config"]["n_timesteps"] == record["agent_steps"] == 2 * ROLLOUT
    assert "commit" in record
    assert str(place.folder) not in place.done.read_text()
    (result,) = find_results(place.folder / "results" / "tiny")
    assert (result.env, result.label, result.seed) == (ENV, "small", 0)

    monkeypatch.setattr(jobs.train, "train", pytest.fail)
    assert jobs.run_job(place) == 0
    place.done.unlink()  # killed while it was evaluated: training is not repeated
    assert jobs.run_job(place) == 0


def test_what_was_stopped_early_is_not_finished(place, monkeypatch):
    def stop_early(flags):
        run = place.log_folder / "e2c_t" / f"{ENV}_1"
        run.mkdir(parents=True)
        (run / f"{ENV}.zip").touch()
        (run / "progress.csv").write_text(f"time/total_timesteps\n{ROLLOUT}\n")

    monkeypatch.setattr(jobs.train, "train", stop_early)
    assert jobs.run_job(place) == INTERRUPTED
    assert not place.done.exists()
    assert place.steps() == ROLLOUT


def test_an_interrupted_run_goes_on_from_its_resume_point(place, monkeypatch):
    assert jobs.continue_or_restart(place) == train_flags(place)
    run = place.log_folder / "e2c_t" / f"{ENV}_1"
    run.mkdir(parents=True)
    monkeypatch.setattr(jobs, "newest_point", lambda path: path == run or None)
    assert jobs.continue_or_restart(place) == ["--resume", str(run)]
    monkeypatch.setattr(jobs, "newest_point", lambda path: None)
    assert jobs.continue_or_restart(place) == train_flags(place)
    assert not run.exists()


def test_what_was_begun_with_other_settings_is_forgotten(place):
    write_json(place.work / "job.json", {"seed": 5})
    place.log_folder.mkdir()
    jobs._forget_other_settings(place)
    assert not place.log_folder.exists()
    place.log_folder.mkdir()
    jobs._forget_other_settings(place)
    assert place.log_folder.exists()


def test_a_job_that_somebody_works_on_is_left_alone(place):
    assert not jobs.is_busy(place)
    place.work.mkdir(parents=True)
    with FileLock(place.lock):
        assert jobs.is_busy(place)
        assert jobs.run_job(place) == BUSY
    assert not jobs.is_busy(place)


def test_a_job_ends_with_the_process_that_started_it(monkeypatch):
    ended = threading.Event()
    signals = []
    monkeypatch.setattr(jobs.os, "read", lambda *_: b"")  # stdin closes with whoever held it
    monkeypatch.setattr(jobs.os, "kill", lambda pid, number: signals.append((pid, number)))
    monkeypatch.setattr(jobs.os, "_exit", lambda _: ended.set())
    monkeypatch.setattr(jobs, "GRACE", 0.0)
    jobs._end_with_parent()
    assert ended.wait(10)
    assert signals == [(os.getpid(), signal.SIGTERM)]


# ---------------------------------------------------------------------------- many jobs

FINISH = """
import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
result = {"team_return": 0.5, "team_cost": 2.0, "cost_limits": [3.0]}
(folder / "evaluation.json").write_text(json.dumps({"sampled": result}))
(folder / "run.json").write_text("{}")
"""
FAIL = "print('first'); print('sb3-e2c: error: no such thing'); raise SystemExit(2)"
CRASH = "import os; os.kill(os.getpid(), 9)"


@pytest.fixture
def run_fake(suite_file, tmp_path, monkeypatch):
    """Run the suite with other programs as jobs: a mapping of names to code; default: FINISH."""
    started = []

    def run(programs=None, n_jobs=2):
        def start(place):
            started.append(place.job.name)
            code = (programs or {}).get(place.job.name, FINISH)
            place.work.mkdir(parents=True, exist_ok=True)
            command = [sys.executable, "-c", textwrap.dedent(code), str(place.results)]
            with place.log.open("ab") as log:
                streams = {"stdin": subprocess.PIPE, "stdout": log, "stderr": log}
                return subprocess.Popen(command, start_new_session=True, **streams)

        monkeypatch.setattr(benchmark, "_make_pool", lambda _: pools.LocalPool(n_jobs, start))
        monkeypatch.setattr(benchmark, "_LOOK_EVERY", 0.02)
        started.clear()
        benchmark.main(["--suite", str(suite_file), "-f", str(tmp_path / "out")])

    run.started = started
    return run


def test_finished_jobs_are_skipped_the_next_time(run_fake, tmp_path, capsys):
    run_fake()
    assert len(run_fake.started) == 4
    text = capsys.readouterr().out
    assert f"done   {ENV}/small/seed_0: return 0.500, cost 2.00 (limit 3)" in text
    assert "4/4 jobs done" in text
    (tmp_path / f"out/results/tiny/{ENV}/small/seed_1/run.json").unlink()
    run_fake()
    assert run_fake.started == [f"{ENV}/small/seed_1"]


def test_a_failed_job_is_recorded_and_does_not_stop_the_others(run_fake, tmp_path, capsys):
    names = [f"{ENV}/small/seed_0", f"{ENV}/mappo/seed_0"]
    with pytest.raises(SystemExit) as exit_:
        run_fake(dict(zip(names, (FAIL, CRASH), strict=True)))
    assert exit_.value.code == 1
    shown = capsys.readouterr()
    assert "2/4 jobs done, 0 running, 2 failed" in shown.out
    assert f"{names[0]}: no such thing" in shown.err
    assert "ended by SIGKILL" in shown.err
    failure = read_json(tmp_path / "out/results/tiny" / names[0] / "failure.json")
    assert failure["status"] == 2
    assert failure["last_lines"] == ["first", "sb3-e2c: error: no such thing"]


def test_an_unknown_environment_spoils_only_its_own_jobs(run_fake, suite_file, capsys):
    suite_file.write_text(TINY.replace(f"[{ENV}]", f"[Nowhere-v0, {ENV}]"))
    with pytest.raises(SystemExit) as exit_:
        run_fake()
    assert exit_.value.code == 1
    shown = capsys.readouterr()
    assert "4/4 jobs done" in shown.out
    at_once, at_the_end = shown.err.split("4 jobs failed:")
    reason = "Nowhere-v0/small/seed_0 and 3 more: unknown environment"
    assert f"cannot run: {reason}" in at_once
    assert reason in at_the_end


def test_ctrl_c_stops_the_jobs_and_says_how_to_go_on(run_fake, capsys):
    sleep = "import os, signal, time; os.kill(os.getppid(), signal.SIGTERM); time.sleep(60)"
    before = time.monotonic()
    with pytest.raises(SystemExit) as exit_:
        run_fake({f"{ENV}/small/seed_0": sleep}, n_jobs=1)
    assert exit_.value.code == 130
    assert time.monotonic() - before < 20
    assert "Go on with: sb3-e2c benchmark --suite" in capsys.readouterr().err


def test_a_job_that_another_process_holds_is_done_later(run_fake, place):
    place.work.mkdir(parents=True)
    lock = FileLock(place.lock)
    lock.acquire()
    real = jobs.is_busy

    def is_busy(asked):
        if len(run_fake.started) == 3:  # all the others
            lock.release()
        return real(asked)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "is_busy", is_busy)
        run_fake()
    assert run_fake.started[-1] == place.job.name
    assert len(run_fake.started) == 4


def test_finished_jobs_with_other_settings_are_refused(suite_file, place, capsys):
    write_json(place.done, {"config": {**place.job.configuration(), "gamma": 0.5}})
    write_json(place.results / "evaluation.json", {})
    line = refusal(capsys, ["--suite", suite_file, "-f", place.folder])
    assert "gamma: 0.5, now 0.9" in line


@pytest.mark.parametrize("name", ["run.json", "evaluation.json"])
def test_a_damaged_result_is_named_with_what_to_do(name, suite_file, place, capsys):
    write_json(place.done, {"config": place.job.configuration()})
    write_json(place.results / "evaluation.json", {})
    (place.results / name).write_text("{")
    line = refusal(capsys, ["--suite", suite_file, "-f", place.folder])
    assert f"cannot read {place.results / name}" in line
    assert f"remove {place.results} and run the benchmark again" in line


def test_a_dry_run_only_lists(suite_file, tmp_path, capsys):
    out = tmp_path / "out"
    cli.main(["benchmark", "--suite", str(suite_file), "-f", str(out), "--dry-run"])
    text = capsys.readouterr().out
    assert f"{ENV} small: seeds 0, 1; 1,920 agent steps; limit 20; 0 done" in text
    assert "4 of 4 jobs to do" in text
    assert not out.exists()


def test_time_left_is_what_is_left_by_the_rate_so_far(place, monkeypatch):
    clock = iter([100.0, 110.0, 110.0, 110.0])
    monkeypatch.setattr(benchmark.time, "monotonic", lambda: next(clock))
    progress = benchmark.Progress({place: 1000})
    place.work.mkdir(parents=True)
    (place.work / "progress.csv").write_text("time/total_timesteps\n250\n")
    progress.look([place], [])
    assert progress.rate == 25.0
    assert progress.seconds_left == 30.0


def test_ray_is_asked_for_in_one_line(suite_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    flags = ["--suite", suite_file, "-f", tmp_path, "--ray", "local"]
    assert "pip install 'sb3-e2c[distributed]'" in refusal(capsys, flags)


class FakeRay:
    """A Ray that runs each task when it is asked for."""

    def __init__(self):
        self.exceptions = SimpleNamespace(RayError=ConnectionError)

    def init(self, **flags):
        self.flags = flags

    def remote(self, **options):
        self.options = options
        return lambda function: type(
            "Task", (), {"remote": staticmethod(lambda *a: (function, a[1]["seed"]))}
        )

    def cluster_resources(self):
        return {"CPU": 2}

    def wait(self, tasks, num_returns, timeout):
        return tasks, []

    def get(self, task):
        if task[1] == 1:
            raise ConnectionError("the node died four times")
        return 0

    def cancel(self, task):
        self.cancelled = task

    def shutdown(self):
        self.flags = None


def test_ray_repeats_lost_jobs_and_reports_those_it_gives_up(suite_file, tmp_path, monkeypatch):
    ray = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    pool = pools.RayPool("local", None)
    assert ray.options == {"num_cpus": 1, "max_retries": 3}
    jobs_ = [job for job in read_suite(suite_file).jobs() if job.method.label == "small"]
    for job in jobs_:
        assert pool.has_room()
        pool.start(Place(tmp_path, job))
    assert not pool.has_room()
    outcomes = {outcome.place.job.seed: outcome for outcome in pool.collect()}
    assert not outcomes[0].failed
    assert "the node died four times" in outcomes[1].message
    assert pool.running() == []


def test_a_cluster_that_does_not_answer_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    with pytest.raises(UserError, match="no cluster answers there"):
        pools.RayPool("127.0.0.1:9", None)
