"""The benchmark of stepping runs and reports; how fast is never a test."""

import json
import statistics

import pytest

pytest.importorskip("rl_zoo3")

from sb3_e2c.zoo import cli, stepping

SMALL = ["--rounds", "2", "--seconds", "0.01", "--worlds", "2"]


@pytest.mark.parametrize("env", ["MultiRover-6-2-v0", "KeepAway-v0"])
def test_it_compares_all_worlds_at_once_with_one_after_the_other(tmp_path, capsys, env):
    file = tmp_path / "out.json"
    stepping.main(["--env", env, "--json", str(file), *SMALL])
    ours, theirs = json.loads(file.read_text())["results"]
    assert len(ours["ratios"]) == len(theirs["ratios"]) == 2
    assert min(each["world_steps_per_second"] for each in (ours, theirs)) > 0
    printed = capsys.readouterr().out
    assert f"{statistics.median(theirs['ratios']):.1f} (" in printed


def test_a_ratio_is_ours_over_theirs_of_the_same_turn_without_the_first(monkeypatch):
    class Canned(stepping.Stepper):
        def take_turn(self, seconds, clock):
            self.rates.append(turns[self.name].pop(0))

    turns = {"ours": [100.0, 6.0, 8.0, 9.0], "theirs": [1.0, 3.0, 1.0, 2.0]}
    few = [Canned(name, 1, lambda: None) for name in turns]
    monkeypatch.setattr(stepping, "_steppers", lambda env_id, n_worlds: few)
    flags = ["--env", "KeepAway-v0", "--rounds", "3"]
    ours, theirs = stepping.measure(stepping.make_parser().parse_args(flags))["results"]
    assert theirs["ratios"] == [2.0, 8.0, 4.5]
    assert ours["ratios"] == [1.0, 1.0, 1.0]
    assert (ours["world_steps_per_second"], theirs["world_steps_per_second"]) == (8.0, 2.0)


def test_robots_also_meet_those_of_others():
    pytest.importorskip("gymnasium_robotics")
    outcome = stepping.measure(
        stepping.make_parser().parse_args(["--env", "SafeHalfCheetah-2x3-v0", *SMALL])
    )
    names = [each["name"] for each in outcome["results"]]
    assert "gymnasium HalfCheetah-v5, 1 world" in names
    assert "gymnasium-robotics through SuperSuit, 8 worlds" in names


def test_a_turn_counts_the_steps_of_all_worlds():
    ticks = iter([0.0, 0.0, 1.0, 2.0])  # start, then after 0, 1 and 2 steps
    stepper = stepping.Stepper("x", n_worlds=3, step=lambda: None)
    stepper.take_turn(2.0, lambda: next(ticks))
    assert stepper.rates == [3.0]  # 2 steps of 3 worlds in 2 seconds


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env", "KeepAwy-v0"], "did you mean 'KeepAway-v0'"),
        (["--worlds", "0"], "--worlds is 0; expected more than 0"),
        (["--rounds", "0"], "--rounds is 0; expected more than 0"),
        (["--seconds", "nan"], "--seconds is nan; expected more than 0"),
    ],
)
def test_a_mistake_is_one_line(capsys, flags, words):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["stepping", *flags])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line
