"""Short forms of tests/torture, whose long form ``make torture`` runs."""

import errno
import random
import signal
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rl_zoo3")
if sys.platform != "linux":
    pytest.skip("kills processes and reads /proc", allow_module_level=True)

from torture import crash, fuzz, soak, untrusted
from torture.runs import PREY, ROVERS, flags, results, run_in, trained, wait

from sb3_e2c.zoo import build, runs, train
from sb3_e2c.zoo.configuration import read_yaml
from sb3_e2c.zoo.console import UserError


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """What an undisturbed run learns."""
    return results(trained(tmp_path_factory.mktemp("straight")))


# ---------------------------------------------------------------------------- crashes


@pytest.mark.parametrize("kill", crash.KILLS.values(), ids=lambda kill: kill.__name__)
def test_a_run_that_is_killed_again_and_again_ends_like_an_undisturbed_one(kill, tmp_path):
    tried, lost, wrong, notes = crash.kills(tmp_path, kill, n=4, rollouts=6, seed=1)
    assert tried >= 4
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
    return {each.fault: each for each in fuzz.torture(tmp_path_factory.mktemp("fuzz"), n=300)}


def test_whatever_is_typed_or_spoiled_works_or_is_one_clear_error(fuzzed):
    assert sum(each.tried for each in fuzzed.values()) >= 250
    assert {each.fault: each.notes for each in fuzzed.values() if each.notes} == {}


def test_a_traceback_and_a_hang_are_seen(monkeypatch):
    monkeypatch.setattr(fuzz, "SECONDS", 0.1)

    def act(number):
        if number == 1:
            raise KeyError("traceback")
        while number == 2:
            pass

    monkeypatch.setattr(fuzz.deadline, "__wrapped__", fuzz.deadline.__wrapped__, raising=False)
    found = fuzz.fuzz("test", st.integers(0, 2), act, 30)
    assert found.wrong >= 2
    assert any("KeyError" in note for note in found.notes)
    assert any("hang" in note for note in found.notes)


@given(text=fuzz.yamls(fuzz.configurations))
@settings(max_examples=50, deadline=None, database=None, derandomize=True)
def test_yaml_is_a_mapping_or_a_user_error(text, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "fuzzed.yml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        assert isinstance(read_yaml(path), dict)
    except UserError as error:
        assert str(path) in str(error)
