"""A stranger's run: payloads in every pickled place, archives that lie; every command is tried."""

import base64
import hashlib
import io
import json
import pickle
import resource
import shutil
import stat
import tarfile
import time
import zipfile
from pathlib import Path

import numpy as np
import torch as th
import yaml

from sb3_e2c.zoo import enjoy, export, plot, push, record, train
from torture.runs import PREY, Outcome, fork, quietly, rollout, trained, wait

PAYLOADS = ("zip", "legacy", "plain", "tar")  # how torch has saved, over the years
BOMB = 2**28  # bytes; a file of the run has some kilobytes
MEMORY = 2**27  # bytes more than before that a command may take to refuse one
SECONDS = 60.0  # this machine may be busy


class Payload:
    """Unpickling it creates a file."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


def commands(logs, out):
    """Every command that reads a run, by a name for people."""
    one = ["--algo", "e2c_t", "--env", PREY, "-f", logs]
    few = ["--n-episodes", "2", "--n-envs", "2", "--verbose", "0", "--device", "cpu"]
    run = logs / "e2c_t" / f"{PREY}_1"
    short = ["-n", str(rollout(PREY)), "--eval-freq", "-1", "--n-eval-envs", "1", "--verbose", "0"]
    zips = [run / f"{PREY}.adversary.zip", run / f"{PREY}.zip"]
    return {
        "enjoy": (enjoy.main, [*one, *few]),
        "enjoy --load-best": (enjoy.main, [*one, *few, "--load-best"]),
        "enjoy --load-last-checkpoint": (enjoy.main, [*one, *few, "--load-last-checkpoint"]),
        "enjoy --opponent FILE": (enjoy.main, [*one, *few, "--opponent", *zips]),
        "record": (record.main, [*one, "-o", out / "a.gif", "--every-checkpoint"]),
        "export": (export.main, [*one, "-o", out / "export"]),
        "push": (push.main, [*one, *few, "--no-render", "--folder-only", out / "hub"]),
        "plot": (plot.main, [run, "-o", out / "a.png"]),
        "train --opponent FILE": (
            train.main,
            [
                *("--env", PREY, "-f", out / "logs", "--opponent", zips[0], *short),
                *("-params", "n_envs:2", "n_steps:20", "n_epochs:1", "policy_kwargs.net_arch:[8]"),
            ],
        ),
        "train -i FILE": (train.main, ["--env", PREY, "-f", out / "logs", "-i", zips[1], *short]),
    }


# ---------------------------------------------------------------------------- payloads


def pickled(payload, how):
    """A payload as torch or pickle would save it."""
    file = io.BytesIO()
    if how == "plain":
        pickle.dump(payload, file)
    elif how == "tar":
        with tarfile.open(fileobj=file, mode="w") as archive:
            for name in ("storages", "tensors", "pickle"):
                content = pickle.dumps(payload)
                member = tarfile.TarInfo(name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
    else:
        th.save({"weights": payload}, file, _use_new_zipfile_serialization=how == "zip")
    return file.getvalue()


def rewrite(archive, name, content):
    """Replace a member of a zip file, or add one."""
    with zipfile.ZipFile(archive) as file:
        members = {each: file.read(each) for each in file.namelist()}
    members[name] = content(members[name]) if callable(content) else content
    with zipfile.ZipFile(archive, "w") as file:
        for each, data in members.items():
            file.writestr(each, data)


def in_data(payload):
    """Change the JSON of a model: a pickled attribute more, and one instead of each other."""
    code = base64.b64encode(pickle.dumps(payload)).decode()

    def change(old):
        found = json.loads(old)
        poisoned = {key: value for key, value in found.items() if isinstance(value, dict)}
        for key in [*poisoned, "poison"]:
            found[key] = {":type:": "Payload", ":serialized:": code}
        return json.dumps(found).encode()

    return change


def poisons(run, payload):
    """Every place of a run that could be unpickled: its name, and what poisons it."""
    models = [path.name for path in sorted(run.glob("*.zip"))]
    for model in models:
        with zipfile.ZipFile(run / model) as file:
            members = file.namelist()
        yield f"{model}: data", lambda r, m=model: rewrite(r / m, "data", in_data(payload))
        for member in [each for each in members if each.endswith(".pth")] + ["more.pth"]:
            for how in PAYLOADS if model == f"{PREY}.zip" else PAYLOADS[:1]:
                yield (
                    f"{model}: {member} ({how})",
                    lambda r, m=model, e=member, h=how: rewrite(r / m, e, pickled(payload, h)),
                )
    for path in sorted(run.rglob("*.npz")):
        name = path.relative_to(run)
        yield f"{name}: object arrays", lambda r, n=name: _objects(r / n, payload)
        yield f"{name}: a pickle", lambda r, n=name: (r / n).write_bytes(pickled(payload, "plain"))
    for path in sorted(run.rglob("*.pkl")):
        name = path.relative_to(run)
        yield f"{name}", lambda r, n=name: (r / n).write_bytes(pickled(payload, "plain"))
    yield "resume points", lambda r: _points(r, payload)
    code = "!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{}']]"
    for name in ("config.yml", "args.yml"):
        text = code.format(payload.trace)
        yield f"{name}: objects", lambda r, n=name, t=text: _append(r / PREY / n, f"\nn_envs: {t}")
    yield "config.yml: callback", lambda r: _callback(r, payload.trace)


def _objects(path, payload):
    with np.load(path) as file:
        names = file.files
    np.savez(path, **{name: np.array([payload], dtype=object) for name in names})


def _points(run, payload):
    for path in (run / "resume").glob("*.point"):
        about = path.read_bytes().split(b"\n")[1]
        body = about + b"\n" + pickle.dumps(payload)
        path.write_bytes(hashlib.sha256(body).hexdigest().encode() + b"\n" + body)


def _append(path, text):
    lines = [line for line in path.read_text().splitlines() if not line.startswith("n_envs")]
    path.write_text("\n".join(lines) + text + "\n")


def _callback(run, trace):
    """RL-Zoo imports a callback by its name, and calls it."""
    command = {"subprocess.run": {"args": ["touch", str(trace)]}}
    _change(run / PREY / "config.yml", callback=command)


def _change(path, **values):
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **values}))


# ---------------------------------------------------------------------------- archives that lie


def lies():
    """What a stranger may do to a run without any pickle; all but the last must be refused."""
    weights, statistics = f"{PREY}.zip", f"{PREY}.vecnormalize.npz"
    return {
        "zip slip: ../": lambda r: _add(r / weights, "../../slipped.pth"),
        "zip slip: absolute": lambda r: _add(r / weights, "/slipped.pth"),
        "zip slip: backslashes": lambda r: _add(r / weights, "..\\slipped"),
        "symbolic link in the archive": lambda r: _link(r / weights),
        "bomb: a member": lambda r: _bomb(r / weights, "more.pth"),
        "bomb: the weights": lambda r: _bomb(r / weights, "policy.pth"),
        "bomb: inside the weights": lambda r: rewrite(r / weights, "policy.pth", _inner_bomb),
        "bomb: undeclared size": lambda r: _undeclared(r / weights, "policy.pth"),
        "bomb: stretched arrays": lambda r: rewrite(r / weights, "policy.optimizer.pth", _stretch),
        "bomb: the adversary": lambda r: _bomb(r / f"{PREY}.adversary.zip", "policy.pth"),
        "bomb: statistics": lambda r: _bomb(r / statistics, "obs_rms.mean.npy"),
        "bomb: an array's claim": lambda r: rewrite(r / statistics, "obs_rms.mean.npy", _claim()),
        "bomb: aliases in YAML": lambda r: _append(r / PREY / "config.yml", _laughs()),
        "bomb: merges in YAML": lambda r: _append(r / PREY / "config.yml", _merges()),
        "bomb: levels of YAML": lambda r: _append(r / PREY / "config.yml", "\na: " + "[" * 9999),
        "bomb: a YAML that is itself": lambda r: _append(r / PREY / "config.yml", "\na: &a [*a]"),
        "bomb: a large YAML": lambda r: _append(r / PREY / "config.yml", "\na: b" * 2**20),
        "bomb: networks": lambda r: _change(
            r / PREY / "config.yml", policy_kwargs={"net_arch": [2**17, 2**17]}
        ),
        "bomb: a memory": lambda r: _change(
            r / PREY / "config.yml", policy="GruPolicy", policy_kwargs={"gru_hidden_size": 2**17}
        ),
        "bomb: a rollout": lambda r: _change(r / PREY / "config.yml", n_steps=10**12),
    }


def _add(archive, name):
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr(name, b"slipped")


def _link(archive):
    with zipfile.ZipFile(archive, "a") as file:
        member = zipfile.ZipInfo("passwords")
        member.external_attr = (stat.S_IFLNK | 0o777) << 16
        file.writestr(member, "/etc/passwd")


def _bomb(archive, name):
    with zipfile.ZipFile(archive) as file:
        members = {each: file.read(each) for each in file.namelist() if each != name}
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for each, data in members.items():
            file.writestr(each, data)
        _pour(file, name)


def _pour(file, name):
    with file.open(name, "w", force_zip64=True) as member:
        for _ in range(BOMB // 2**24):
            member.write(bytes(2**24))


def _inner_bomb(old):
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(old)) as before:
        names = before.namelist()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as after:
            for name in names:
                if name.endswith("data/0"):
                    _pour(after, name)
                else:
                    after.writestr(name, before.read(name))
    return file.getvalue()


def _undeclared(archive, name):
    """A bomb whose directory claims a small size."""
    _bomb(archive, name)
    content = archive.read_bytes()
    for size in (BOMB, BOMB - 1):
        content = content.replace(size.to_bytes(4, "little"), (1000).to_bytes(4, "little"))
    archive.write_bytes(content)


def _stretch(old):
    state = th.load(io.BytesIO(old))
    for moments in state["state"].values():
        moments["exp_avg"] = th.zeros(1, dtype=th.float64).expand(2**40)
    file = io.BytesIO()
    th.save(state, file)
    return file.getvalue()


def _claim():
    file = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (2**45,)}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + bytes(80)


def _laughs():
    lines = ["\na: &a0 [1,1,1,1,1,1,1,1,1,1]"]
    lines += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    return "\n".join(lines)


def _merges():
    lines = ["\na: &a0 {b: 1, c: 2, d: 3}"]
    lines += [f"a{n}: &a{n} {{<<: [{','.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, 12)]
    return "\n".join(lines)


# ---------------------------------------------------------------------------- trials


def _judge(main, argv, trace):
    """Exit status for a parent: 0 in order, 1 a traceback, 2 code executed, 3 too much memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        status, _, error = quietly(main, argv)
    except BaseException as bug:
        print(f"    {type(bug).__name__}: {str(bug)[:300]}", flush=True)
        raise SystemExit(1) from None
    if trace.exists():
        raise SystemExit(2)
    if 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) > MEMORY:
        raise SystemExit(3)
    if status not in (0, 2) or (status == 2 and len(error.strip().splitlines()) != 1):
        print(f"    status {status}: {error[:300]}", flush=True)
        raise SystemExit(1)
    raise SystemExit(0 if status == 0 else 9)


WORDS = {1: "traceback", 2: "executed", 3: "memory", -9: "killed", 4: "slow"}


def attempt(logs, spoil, names, trace, work):
    """Spoil a copy of a run, and let commands at it.

    :return: By command "works", "refused", or what is wrong
    """
    copy = work / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(logs, copy)
    spoil(copy / "e2c_t" / f"{PREY}_1")
    found = {}
    for name in names:
        out = work / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        main, argv = commands(copy, out)[name]
        start = time.monotonic()
        status = wait(fork(_judge, main, argv, trace))
        slow = time.monotonic() - start > SECONDS
        found[name] = {0: "works", 9: "refused"}.get(status) or WORDS.get(status, f"{status}")
        found[name] = "slow" if slow else found[name]
        trace.unlink(missing_ok=True)
    return found


def control(logs, work):
    """The payloads are live: who unpickles them is found out. Raises if one is not."""
    trace = work / "executed"
    for how in ("zip", "legacy", "plain"):
        data = io.BytesIO(pickled(Payload(trace), how))
        th.load(data, weights_only=False) if how != "plain" else pickle.load(data)
        assert trace.exists(), how
        trace.unlink()
    trials = {
        "enjoy": lambda run: rewrite(run / f"{PREY}.zip", "data", in_data(Payload(trace))),
        "train -i FILE": lambda run: _callback(run, trace),
    }
    for command, spoil in trials.items():
        copy = work / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(logs, copy)
        spoil(copy / "e2c_t" / f"{PREY}_1")
        main, argv = commands(copy, work)[command]
        wait(fork(quietly, main, [*argv, "--trust"]))
        assert trace.exists(), f"{command} --trust executes nothing"
        trace.unlink()


# Which commands look at which file; the others would only try the same again.
_READ_BY = {
    "best_model": ["enjoy --load-best"],
    "rl_model": ["enjoy --load-last-checkpoint", "record"],
    f"{PREY}.adversary": [
        *("enjoy", "enjoy --opponent FILE", "train --opponent FILE", "train -i FILE", "push"),
    ],
    "evaluations": ["plot", "enjoy"],
}


def readers(place):
    """Commands to try."""
    for start, names in _READ_BY.items():
        if place.startswith(start):
            return names
    return ["enjoy", "export", "train -i FILE"]


def _everywhere(spoils):
    """Poisons whatever can be without being refused for its form."""

    def spoil(run):
        for place, each in spoils.items():
            if place.endswith(("data", ".pkl", "points", "callback", "more.pth (zip)")):
                each(run)

    return spoil


def torture(work, every=True):
    """Try payloads and lies.

    :param work: An empty folder
    :param every: Whether payloads are tried in every format that torch has had
    :return: Two lines of the table
    """
    logs, trace = work / "logs", work / "executed"
    run = trained(logs, PREY)
    control(logs, work)
    spoils = dict(poisons(run, Payload(trace)))
    if not every:
        spoils = {name: spoils[name] for name in spoils if "(" not in name or "(zip" in name}
    tried = {(place, spoil): readers(place) for place, spoil in spoils.items()}
    tried["everywhere", _everywhere(spoils)] = list(commands(logs, work))
    yield _outcome("payloads in pickled places", logs, tried, trace, work, "works", "refused")
    tried = {each: ["enjoy", "export", "train -i FILE"] for each in lies().items()}
    yield _outcome("zip slips, bombs of zip and YAML", logs, tried, trace, work, "refused")


def _outcome(fault, logs, tries, trace, work, *fine):
    tried, wrong = 0, []
    for (place, spoil), names in tries.items():
        for name, found in attempt(logs, spoil, names, trace, work).items():
            tried += 1
            if found not in fine:
                wrong.append(f"{place}, {name}: {found}")
    return Outcome(fault, tried, wrong=len(wrong), notes=tuple(wrong))
