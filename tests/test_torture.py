"""Short forms of tests/torture, whose long form ``make torture`` runs."""

import errno
import random
import shutil
import signal
import sys

import pytest
from hypothesis import strategies as st

pytest.importorskip("rl_zoo3")
if sys.platform != "linux":
    pytest.skip("kills processes and reads /proc", allow_module_level=True)

from torture import crash, fuzz, soak, untrusted
from torture.runs import PREY, flags, results, run_in, trained, wait

from sb3_e2c.zoo import build, train


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """What an undisturbed run learns."""
    return results(trained(tmp_path_factory.mktemp("straight")))


# ---------------------------------------------------------------------------- crashes


@pytest.mark.parametrize("kill", crash.KILLS.values(), ids=lambda kill: kill.__name__)
def test_a_run_that_is_killed_again_and_again_ends_like_an_undisturbed_one(kill, tmp_path):
    tried, lost, wrong, notes = crash.kills(tmp_path, kill, n=2, rollouts=12, seed=1)
    assert tried >= 2
    assert (lost, wrong, notes) == (0, 0, [])


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_refuses_is_one_line_and_the_run_goes_on_later(tmp_path, reference, number):
    trouble = crash.Fault(random.Random(number).randint(60, 120), crash.disk_says(number))
    assert crash.refused_then_resumed(tmp_path / "run", trouble.install, reference) is None


def test_files_that_may_not_grow_are_one_line_and_the_run_goes_on_later(tmp_path, reference):
    def trouble():
        crash.limit_files(9_000)

    assert crash.refused_then_resumed(tmp_path / "run", trouble, reference) is None


@pytest.mark.parametrize("how", ["delete", "rename"])
def test_a_folder_that_is_gone_is_one_line(tmp_path, how):
    assert crash.deleted(tmp_path / "run", how) is None


def test_a_fault_finds_a_file_half_written(tmp_path):
    pid = crash.train_with(crash.Fault(3, crash.die), flags(tmp_path))  # mkstemp counts twice
    assert wait(pid) == -signal.SIGKILL
    (left,) = tmp_path.rglob(".*")
    assert left.stat().st_size > 0


# ---------------------------------------------------------------------------- fuzz


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory):
    return {each.fault: each for each in fuzz.torture(tmp_path_factory.mktemp("fuzz"), n=80)}


def test_whatever_is_typed_or_spoiled_works_or_is_one_clear_error(fuzzed):
    assert sum(each.tried for each in fuzzed.values()) >= 60
    assert {each.fault: each.notes for each in fuzzed.values() if each.notes} == {}


def test_a_traceback_and_a_hang_are_seen(monkeypatch):
    monkeypatch.setattr(fuzz, "SECONDS", 0.1)

    def act(number):
        if number == 1:
            raise KeyError("traceback")
        while number == 2:
            pass

    found = fuzz.fuzz("test", st.integers(0, 2), act, 30)
    assert found.wrong >= 2
    assert any("KeyError" in note for note in found.notes)
    assert any("hang" in note for note in found.notes)


# ---------------------------------------------------------------------------- a stranger's run


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """A log folder with a run whose files others may have changed."""
    logs = tmp_path_factory.mktemp("stranger") / "logs"
    trained(logs, PREY)
    return logs


def tried(stranger, tmp_path, spoil, *names):
    """What commands make of a spoiled copy of the run."""
    return untrusted.attempt(stranger, spoil, names, tmp_path / "executed", tmp_path)


def test_payloads_are_live_and_trust_executes_them(stranger, tmp_path):
    untrusted.control(stranger, tmp_path)


@pytest.mark.parametrize(
    ("place", "command"),
    [
        (f"{PREY}.zip: data", "export"),
        (f"{PREY}.zip: policy.pth (zip)", "enjoy"),
        (f"{PREY}.zip: policy.optimizer.pth (tar)", "push"),
        (f"{PREY}.adversary.zip: policy.pth (zip)", "train --opponent FILE"),
        (f"{PREY}.vecnormalize.npz: object arrays", "enjoy"),
        (f"{PREY}/vecnormalize.pkl", "enjoy"),
        ("resume points", "enjoy"),
        ("config.yml: callback", "plot"),
    ],
)
def test_no_payload_is_executed(stranger, tmp_path, place, command):
    run = run_in(stranger)
    spoils = dict(untrusted.poisons(run, untrusted.Payload(tmp_path / "executed")))
    found = tried(stranger, tmp_path, spoils[place], command)
    assert found[command] in ("works", "refused")


LIES = ["zip slip: ../", "symbolic link in the archive", "bomb: inside the weights"]
LIES += ["bomb: stretched arrays", "bomb: an array's claim", "bomb: merges in YAML"]
LIES += ["bomb: a YAML that is itself", "bomb: networks"]


@pytest.mark.parametrize("lie", LIES)
def test_archives_and_yaml_that_lie_are_refused_in_one_line(stranger, tmp_path, lie):
    assert tried(stranger, tmp_path, untrusted.lies()[lie], "enjoy") == {"enjoy": "refused"}


def test_a_bomb_would_be_seen(stranger, tmp_path, monkeypatch):
    monkeypatch.setattr(build, "check_archive", lambda *_: None)
    spoil = untrusted.lies()["bomb: inside the weights"]
    assert tried(stranger, tmp_path, spoil, "enjoy") == {"enjoy": "memory"}


@pytest.mark.parametrize("flag", ["--resume", "-i"])
def test_a_run_from_the_hub_is_unpickled_only_if_it_is_trusted(stranger, tmp_path, capsys, flag):
    logs = shutil.copytree(stranger, tmp_path / "logs")
    run = run_in(logs)
    untrusted._change(run / PREY / "args.yml", repo_id="somebody/prey", trust=True)
    what = run if flag == "--resume" else run / f"{PREY}.zip"
    argv = [flag, str(what)]
    argv += ["--env", PREY, "-f", str(logs)] if flag == "-i" else []
    with pytest.raises(SystemExit):
        train.main(argv)
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "to unpickle it, which can execute" in line
    assert train.train([*argv, "--trust", "-n", "900", "--verbose", "0"]).exists()


# ---------------------------------------------------------------------------- soak


def test_a_long_training_does_not_grow(tmp_path):
    (found,) = soak.torture(tmp_path, rollouts=200)
    assert found.notes == ()
