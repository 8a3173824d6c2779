"""The speed benchmark runs and reports; how fast is never a test."""

import json

import pytest

from sb3_e2c.zoo import speed

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
SMALL = ["--rounds", "1", "--threads", "1", "--worlds", "1", "--epochs", "1", "--minibatches", "1"]


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
    ("flags", "message"),
    [
        (["--env", "simple_spred"], "simple_spread"),
        (["--rounds", "0"], "--rounds is 0; expected at least 1"),
        (["--policy", "lstm"], "invalid choice"),
    ],
)
def test_mistakes_are_one_line_and_exit_status_2(capsys, flags, message):
    with pytest.raises(SystemExit) as stop:
        speed.main(flags)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
