"""Teams of a benchmark against each other's adversaries."""

import json

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rl_zoo3")

from sb3_e2c.zoo import benchmark, cli, crossplay, plot
from sb3_e2c.zoo.report import readable_crossplay
from sb3_e2c.zoo.suite import read_suite

ENV = "KeepAway-v0"
OTHERS = ("c_mappo/seed_0", "c_mappo/seed_1")
TINY = f"""
seeds: 2
window: 2
eval_episodes: 2
n_timesteps: 480
methods:
  mappo: {{params: &small {{n_envs: 2, n_epochs: 1, policy_kwargs: {{net_arch: [8]}}}}}}
  c_mappo: {{params: *small}}
experiments:
  one: {{envs: [{ENV}], methods: [c_mappo, mappo], baselines: [mappo]}}
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A benchmark of two methods with two seeds, played with 4 episodes for each opponent."""
    folder = tmp_path_factory.mktemp("benchmark")
    (folder / "tiny.yml").write_text(TINY)
    run = ["--suite", str(folder / "tiny.yml"), "-f", str(folder / "out")]
    benchmark.main([*run, "--jobs", "2"])
    flags = [*run, "--n-episodes", "4", "--pool-seeds", "0", "1"]
    crossplay.main(flags)
    return folder, flags, folder / "out/results/tiny/crossplay.csv"


def test_each_team_meets_everybody_but_itself(played):
    table = pd.read_csv(played[2])
    for label, seed, met in (
        ("mappo", 0, {"own", "random", "mappo/seed_1"}),
        ("c_mappo", 1, {"own", "random", "mappo/seed_0", "mappo/seed_1"}),
    ):
        rows = table[(table["label"] == label) & (table["seed"] == seed)]
        assert set(rows["opponent"]) == met
        assert len(rows) == len(met)
    assert (table["episodes"] == 4).all()
    assert np.isfinite(table[["return", "cost"]].to_numpy()).all()
    mine = table[(table["label"] == "mappo") & (table["seed"] == 1)]
    assert mine["return"].nunique() == len(mine)  # other opponents, other episodes


def test_what_has_been_played_is_not_played_again(played, monkeypatch):
    _, flags, path = played
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:-1]) + "\n")
    calls = []
    monkeypatch.setattr(
        crossplay, "play", lambda *a, play=crossplay.play: calls.append(a) or play(*a)
    )
    crossplay.main(flags)
    (call,) = calls
    assert len(call[1]) == 1
    assert path.read_text().splitlines() == rows  # the same episodes again


def test_more_episodes_or_a_new_training_are_played_anew(played, monkeypatch):
    _, flags, path = played
    calls = []
    monkeypatch.setattr(
        crossplay, "play", lambda *a, play=crossplay.play: calls.append(a) or play(*a)
    )
    crossplay.main([*flags[:-5], "--n-episodes", "2", "--pool-seeds", "0", "1"])
    assert sum(len(call[1]) for call in calls) == 14
    assert (pd.read_csv(path)["episodes"] == 2).all()
    crossplay.main(flags)  # as it was
    calls.clear()
    done = path.parent / ENV / "mappo/seed_1/run.json"
    text = done.read_text()
    done.write_text(text.replace(json.loads(text)["finished"], "2100-01-01T00:00:00+00:00"))
    crossplay.main(flags)
    played_again = {(call[0].job.name, name) for call in calls for name in call[1]}
    others = {(f"{ENV}/{run}", "mappo/seed_1") for run in ("mappo/seed_0", *OTHERS)}
    assert played_again == others | {
        (f"{ENV}/mappo/seed_1", n) for n in ("own", "random", "mappo/seed_0")
    }
    assert len(pd.read_csv(path)) == 14
    done.write_text(text)
    crossplay.main(flags)


def test_another_pool_is_added(played):
    _, flags, path = played
    rows = path.read_text().splitlines()
    crossplay.main([*flags, "--pool", "c_mappo"])
    both = pd.read_csv(path)
    assert set(rows) < set(path.read_text().splitlines())
    met = both[(both["label"] == "c_mappo") & (both["seed"] == 0)]["opponent"]
    assert set(met) == {"own", "random", "mappo/seed_0", "mappo/seed_1", "c_mappo/seed_1"}
    crossplay.main(flags)  # keeps it
    pd.testing.assert_frame_equal(pd.read_csv(path), both)
    path.write_text("\n".join(rows) + "\n")


def test_a_table_that_does_not_say_which_runs_met_is_played_anew(played):
    _, flags, path = played
    rows = path.read_text()
    pd.read_csv(path).drop(columns=["trained", "opponent_trained"]).to_csv(path, index=False)
    crossplay.main(flags)
    assert sorted(path.read_text().splitlines()) == sorted(rows.splitlines())


def test_the_report_shows_it(played):
    report = plot.plot_suite(played[2].parent, played[0] / "plots")
    assert "adversaries of other runs" in report.read_text()


def test_the_pool_counts_as_one_opponent_of_each_seed(played):
    suite = read_suite(played[0] / "tiny.yml")
    pool = [(0, "e2c/seed_0", 1), (0, "e2c/seed_1", 3), (1, "e2c/seed_0", 5), (1, "e2c/seed_1", 7)]
    rows = [*pool, (0, "own", 9), (1, "own", 9)]
    table = pd.DataFrame(rows, columns=["seed", "opponent", "return"])
    table = table.assign(env=ENV, label="mappo")
    (row,) = readable_crossplay(suite.experiments[0], table, suite).to_dict("records")
    assert row["return, own"] == "9.0 ± 0.0"
    assert row["return, e2c"] == "4.0 ± 2.0"  # seeds 2 and 6


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--pool", "mapo"], "did you mean 'mappo'"),
        (["--pool-seeds", "7"], "no finished runs of mappo"),
        (["--pool-seeds", "x"], "expected numbers such as"),
        (["--n-episodes", "0"], "expected at least 1"),
    ],
)
def test_a_mistake_is_one_line(played, capsys, flags, words):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["crossplay", *played[1], *flags])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line
