"""Short forms of tests/torture, whose long form ``make torture`` runs."""

import errno
import random
import shutil
import signal
import sys

import numpy as np
import pytest
from hypothesis import strategies as st

pytest.importorskip("rl_zoo3")
if sys.platform != "linux":
    pytest.skip("kills processes and reads /proc", allow_module_level=True)

from torture import crash, fuzz, hub, soak, untrusted
from torture.runs import PREY, flags, results, run_in, trained, wait

from sb3_e2c.zoo import build, load, train


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """What an undisturbed run learns."""
    return results(trained(tmp_path_factory.mktemp("straight")))


# ---------------------------------------------------------------------------- crashes


@pytest.mark.parametrize("kill", crash.KILLS.values(), ids=lambda kill: kill.__name__)
def test_a_run_that_is_killed_again_and_again_ends_like_an_undisturbed_one(kill, tmp_path):
    tried, lost, wrong, notes = crash.kills(tmp_path, kill, n=2, rollouts=12, seed=1)
    assert (lost, wrong, notes) == (0, 0, [])
    assert tried >= 2


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


@pytest.mark.parametrize(
    ("message", "given", "names"),
    [
        ("k is 0; expected at least 1", {"k": 0}, True),
        ("broken", {"k": 3}, False),  # a letter of a word
        ("gamma is {'psi': 1}; expected a number", {"psi": 2}, False),  # stands in a value
        ("boom; found in n_steps=4, policy_kwargs={}", {"n_steps": None}, False),
        ("boom; found in n_steps=4, policy_kwargs={}", {"policy": int}, False),
        ("policy_class is 3; expected a subclass", {"policy": 3}, True),
        ("oem_kwargs: psi is nan; expected a number", {"oem_kwargs": {"psi": "nan"}}, True),
    ],
)
def test_a_message_names_an_argument_by_a_whole_word_before_its_value(message, given, names):
    assert (fuzz._nameless(message, given) is None) is names


@pytest.mark.parametrize(("culprit", "clear"), [("policy_kwargs", True), ("psi", False)])
def test_what_an_error_is_found_in_counts_only_if_it_is_the_cause(culprit, clear, monkeypatch):
    monkeypatch.setattr(fuzz, "_unclear", lambda error: None)  # it is not raised by the library

    def act(given):
        if culprit in given:
            raise ValueError("boom; found in n_steps=4, policy_kwargs={'a': 1}")

    found = fuzz.clear(act, {"policy_kwargs": {"a": 1}, "psi": 2})
    assert (found is None) is clear


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
        ("config.yml: callback", "train -i FILE"),
        (f"{PREY}.zip: data", "train -i FILE"),
        (f"{PREY}.adversary.zip: data", "train -i FILE"),
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
    commands = ("enjoy", "train -i FILE")
    found = tried(stranger, tmp_path, untrusted.lies()[lie], *commands)
    assert found == dict.fromkeys(commands, "refused")


def test_a_bomb_would_be_seen(stranger, tmp_path, monkeypatch):
    monkeypatch.setattr(build, "check_archive", lambda *_: None)
    spoil = untrusted.lies()["bomb: inside the weights"]
    assert tried(stranger, tmp_path, spoil, "enjoy") == {"enjoy": "memory"}


def test_a_run_from_the_hub_is_resumed_only_if_it_is_trusted(stranger, tmp_path, capsys):
    logs = shutil.copytree(stranger, tmp_path / "logs")
    run = run_in(logs)
    untrusted._change(run / PREY / "args.yml", repo_id="somebody/prey", trust=True)
    argv = ["--resume", str(run)]
    with pytest.raises(SystemExit):
        train.main(argv)
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "to unpickle it, which can execute" in line
    assert train.train([*argv, "--trust", "-n", "900", "--verbose", "0"]).exists()


# ---------------------------------------------------------------------------- a hostile hub


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    return hub.published(tmp_path_factory.mktemp("team"))


SENDS = ["more than listed", "nothing after a while", "half of it, as if whole", "a gzip bomb"]
SENDS += ["a byte at a time", "other bytes of the same size", "a redirection to a local file"]


@pytest.mark.parametrize("name", SENDS)
def test_what_a_hub_sends_is_what_it_lists_or_refused_in_one_line(team, tmp_path, name):
    server = hub.Hub(team, send=hub.of_model(hub.SENDS[name]))
    assert hub.attempt(server, tmp_path, tmp_path / "executed") == "refused"


@pytest.mark.parametrize("name", ["a slip", "a size in words", "another sha256", "deep JSON"])
def test_what_a_hub_lists_makes_sense_or_is_refused_in_one_line(team, tmp_path, name):
    server = hub.Hub(team, hub.LISTINGS[name])
    assert hub.attempt(server, tmp_path, tmp_path / "executed") == "refused"


def test_an_honest_hub_is_loaded_from_and_what_is_written_is_measured(team, tmp_path):
    assert hub.attempt(hub.Hub(team), tmp_path, tmp_path / "executed") == "works"
    n_bytes = int((tmp_path / "logs.written").read_text())
    assert sum(map(len, team.values())) <= n_bytes < sum(map(len, team.values())) + hub.LARGE


def test_a_hub_that_fills_the_disk_would_be_seen(team, tmp_path, monkeypatch):
    real = load.fetch

    def fetch(repo_id, revision, file, path):  # as if sizes were checked too late
        file.size = (file.size or 0) + 2 * hub.LARGE
        real(repo_id, revision, file, path)

    monkeypatch.setattr(load, "fetch", fetch)
    server = hub.Hub(team, send=hub.of_model(hub.SENDS["more than listed"]))
    assert "bytes written" in hub.attempt(server, tmp_path, tmp_path / "executed")


# ---------------------------------------------------------------------------- soak


def test_growth_is_found_in_noise_and_noise_is_no_growth():
    times, noise = np.linspace(0, 1000, 360), np.random.default_rng(0).normal(0, 5, 360)
    still, error = soak.growth(times, 400 + noise)
    assert abs(still) < 4 * error
    growing, error = soak.growth(times, 400 + 0.02 * times + noise)  # 20 MiB
    assert growing == pytest.approx(20, abs=4 * error)
    assert growing > 3 * error


def test_what_grows_is_reported(tmp_path, capsys):
    rows = np.zeros((60, len(soak.COLUMNS)))
    columns = dict(zip(soak.COLUMNS, rows.T, strict=True))
    columns["seconds"][:], columns["evaluations"][:] = np.arange(60), 1
    columns["agent_steps"][:], columns["handles"][:] = 1000 * np.arange(60), np.arange(60)
    path = tmp_path / "test.csv"
    np.savetxt(path, rows, delimiter=",", header=",".join(soak.COLUMNS), comments="")
    assert soak.report("test", path) is True
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "GROWS" in line]
    assert "handles" in line
    columns["handles"][:] = 8
    np.savetxt(path, rows, delimiter=",", header=",".join(soak.COLUMNS), comments="")
    assert soak.report("test", path) is False


def test_arrays_that_an_object_holds_are_counted_once():
    inner = {"a": np.zeros(1000), "b": [np.zeros(500, np.int8)]}
    inner["self"] = inner
    once = soak.held([inner])
    assert 8500 < once < 9500  # and a few hundred bytes for the containers
    assert soak.held([inner, inner["a"], int]) == once + 16  # two more places in the list


class _Slots:
    __slots__ = ("rows",)


class _OneSlot:
    __slots__ = "rows"


class _PrivateSlot:
    __slots__ = ("__rows",)

    def __init__(self):
        self.__rows = np.zeros(10_000)


def test_numbers_and_slots_are_counted_too():
    slots = _Slots()
    slots.rows = np.zeros(10_000)
    floats = [float(i) for i in range(10_000)]
    assert soak.held({"x": floats}) > 10_000 * (8 + 24)
    assert soak.held([{"r": i} for i in range(1000)]) > 1000 * 64
    assert soak.held(slots) > 80_000
    one = _OneSlot()
    one.rows = slots.rows
    assert soak.held(one) > 80_000
    assert soak.held(_PrivateSlot()) > 80_000


def test_a_long_chain_of_objects_is_counted():
    chain = []
    for _ in range(10_000):
        chain = [chain]
    assert soak.held(chain) > 10_000 * 56  # of a list with one place


def test_a_long_training_does_not_grow(tmp_path):
    (found,) = soak.torture(tmp_path, rollouts=200)
    assert found.notes == ()
