"""``sb3-e2c push`` and ``load``: what is published, what is fetched, what is refused.

The hub is a small server on this machine that speaks as much HTTP as huggingface_hub needs.
"""

import base64
import io
import json
import pickle
import re
import shlex
import shutil
import struct
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import huggingface_hub
import numpy as np
import pytest
import yaml
from huggingface_hub import ModelCard, constants

pytest.importorskip("rl_zoo3")

from sb3_e2c.zoo import card, cli, hub, load, push, train
from sb3_e2c.zoo.configuration import read_yaml, resolve
from sb3_e2c.zoo.console import StoreDict, UserError
from sb3_e2c.zoo.runs import Run

ALGO, ENV = "e2c_t", "PredatorPrey-v0"
STEPS = 2 * 3 * 80  # a rollout of 2 worlds of 3 predators: one episode each
SMALL = ["n_envs:2", "n_steps:80", "n_epochs:1", "batch_size:240", "policy_kwargs.net_arch:[8]"]
TEAM = {
    *("model.zip", "model.adversary.zip", "model.vecnormalize.npz", "config.yml", "args.yml"),
    *("results.json", "learning.png", "replay.mp4", "README.md"),
}


# ---------------------------------------------------------------------------- a hub


class FakeHub(ThreadingHTTPServer):
    """Repositories in memory; ``lies`` are sizes that its lists give instead of the true ones."""

    token = "hf_test"

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Answers)
        self.repos, self.private, self.revisions, self.lies = {}, {}, [], {}
        self.messages, self.served = [], []

    @property
    def endpoint(self):
        return f"http://127.0.0.1:{self.server_port}"

    def sizes(self, repo):
        return {name: self.lies.get(name, len(data)) for name, data in self.repos[repo].items()}


class _Answers(BaseHTTPRequestHandler):
    sha = "0123456789abcdef0123456789abcdef01234567"

    def log_message(self, *_):
        pass

    def answer(self, body=b"", status=200, **headers):
        body = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def missing(self):
        self.answer({"error": "not found"}, 404, X_Error_Code="RepoNotFound")

    def do_POST(self):
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = urlsplit(self.path).path
        if self.headers.get("Authorization") != f"Bearer {self.server.token}":
            self.answer({"error": "Invalid username or password."}, 401)
        elif path == "/api/repos/create":
            asked = json.loads(body)
            repo = f"{asked['organization']}/{asked['name']}" if "organization" in asked else None
            self.server.repos.setdefault(repo, {".gitattributes": b"*.zip filter=lfs"})
            self.server.private[repo] = asked.get("visibility") == "private"
            self.answer({"url": f"{self.server.endpoint}/{repo}"})
        elif path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif match := re.fullmatch(r"/api/models/(.+/.+)/preupload/main", path):
            files = [file["path"] for file in json.loads(body)["files"]]
            mode = {"uploadMode": "regular", "shouldIgnore": False}
            self.answer({"files": [{"path": name, **mode} for name in files]})
        elif match := re.fullmatch(r"/api/models/(.+/.+)/commit/main", path):
            self.commit(self.server.repos[match[1]], body)
            url = f"{self.server.endpoint}/{match[1]}/commit/{self.sha}"
            self.answer({"success": True, "commitOid": self.sha, "commitUrl": url})
        else:
            self.answer({"error": f"POST {path}"}, 404)

    def commit(self, files, body):
        for entry in map(json.loads, body.splitlines()):
            value = entry["value"]
            if entry["key"] == "header":
                self.server.messages.append(value["summary"])
            elif entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "deletedFile":
                del files[value["path"]]

    def do_GET(self):
        path = unquote(urlsplit(self.path).path)
        repos = self.server.repos
        if match := re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/(revision|tree)/([^/]+))?", path):
            repo, what, revision = match.groups()
            if repo not in repos:
                self.missing()
            elif what == "tree":
                sizes = self.server.sizes(repo).items()
                entry = {"type": "file", "oid": "0" * 40}
                self.answer([{"path": name, "size": size, **entry} for name, size in sizes])
            else:
                self.server.revisions.append(revision)
                sizes = self.server.sizes(repo).items()
                files = [{"rfilename": name, "size": size} for name, size in sizes]
                self.answer({"id": repo, "modelId": repo, "sha": self.sha, "siblings": files})
        elif match := re.fullmatch(rf"/([^/]+/[^/]+)/resolve/{self.sha}/(.+)", path):
            self.server.served.append(match[2])
            digest = f'"{match[2]}"'
            self.answer(repos[match[1]][match[2]], ETag=digest, X_Repo_Commit=self.sha)
        else:
            self.missing()

    do_HEAD = do_GET


@pytest.fixture
def server(monkeypatch, tmp_path):
    """A hub, and a user who is logged in there and works in a folder of their own."""
    with FakeHub() as here:
        threading.Thread(target=here.serve_forever, daemon=True).start()
        template = f"{here.endpoint}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        monkeypatch.setattr(constants, "ENDPOINT", here.endpoint)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setenv("HF_TOKEN", here.token)
        (tmp_path / "work").mkdir()
        monkeypatch.chdir(tmp_path / "work")
        yield here
        huggingface_hub.close_session()
        here.shutdown()


# ---------------------------------------------------------------------------- a team


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log folder with a team, its adversary and the statistics of its observations."""
    folder = tmp_path_factory.mktemp("secret_place")
    argv = ["--algo", ALGO, "--env", ENV, "-n", str(STEPS), "-f", str(folder), "--seed", "1"]
    argv += ["--save-freq", str(STEPS), "--eval-freq", "-1", "--verbose", "0", "--device", "cpu"]
    train.train([*argv, "--wandb-entity", "somebody", "-params", *SMALL, "normalize:true"])
    return folder


@pytest.fixture(scope="module")
def published(trained, tmp_path_factory):
    """The folder that is published, with a film."""
    folder = tmp_path_factory.mktemp("published") / "team"
    run_push(trained, "--folder-only", folder, "--repo-id", "me/team")
    return folder


def run_push(logs, *flags):
    argv = ["--algo", ALGO, "--env", ENV, "-f", logs, "--n-episodes", "3", "--n-envs", "2"]
    cli.main(["push", *(str(word) for word in [*argv, "--device", "cpu", *flags])])


def run_enjoy(logs, out, *flags):
    argv = ["enjoy", "--algo", ALGO, "--env", ENV, "-f", logs, "--n-episodes", "3", "--n-envs", "2"]
    cli.main([str(word) for word in [*argv, "--device", "cpu", "--json", out, *flags]])
    return json.loads(Path(out).read_text())


def refusal(capsys, command, *flags):
    """The one line that a command writes to stderr before it exits with status 2."""
    with pytest.raises(SystemExit) as exit_:
        cli.main([command, *(str(word) for word in flags)])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("sb3-e2c: error: ")
    return lines[0]


def numbers(summary):
    return {key: value for key, value in summary.items() if key not in ("model", "against")}


# ---------------------------------------------------------------------------- what is published


def test_the_folder_has_the_team_and_nothing_else(published):
    assert {path.name for path in published.iterdir()} == TEAM == set(hub.LARGEST)


def test_statistics_are_numbers_and_no_pickle(published):
    with np.load(published / "model.vecnormalize.npz", allow_pickle=False) as file:
        assert "obs_rms.mean" in file.files


def test_nothing_tells_of_the_machine_or_its_user(published):
    assert read_yaml(published / "args.yml") == {
        "algo": ALGO,
        "env": ENV,
        "n_timesteps": STEPS,
        "preset": "headline",
        "seed": 1,
    }
    for path in published.iterdir():
        contents = [path.read_bytes()]
        if path.suffix in (".zip", ".npz"):
            with zipfile.ZipFile(path) as archive:
                contents += [archive.read(name) for name in archive.namelist()]
        for content in contents:
            assert b"secret_place" not in content
            assert b"somebody" not in content


def test_results_are_those_of_enjoy(trained, published, tmp_path):
    results = json.loads((published / "results.json").read_text())
    assert results["episodes"] == 3
    assert results["deterministic"] is False
    assert results["model"] == f"{ENV}.zip"
    assert results["trained_steps"] == STEPS
    expected = run_enjoy(trained, tmp_path / "out.json")
    assert {key: results[key] for key in numbers(expected)} == numbers(expected)


def test_the_card_tells_the_hub_the_results(published):
    results = json.loads((published / "results.json").read_text())
    about = ModelCard.load(published / "README.md").data
    assert about.to_dict()["library_name"] == "stable-baselines3"
    assert {ENV, "reinforcement-learning", "sb3-e2c"} <= set(about.tags)
    metrics = {each.metric_type: each for each in about.eval_results}
    reward, error = results["team_return"], results["team_return_se"]
    assert metrics["mean_reward"].metric_value == f"{reward:.3f} +/- {error:.3f}"
    assert metrics["mean_reward"].dataset_name == ENV
    assert metrics["mean_cost"].metric_value.startswith(f"{results['team_cost']:.3f}")


def test_the_card_tells_people_how_to_go_on(published):
    text = (published / "README.md").read_text()
    assert "sb3-e2c load --repo-id me/team -f logs\n" in text
    assert f"sb3-e2c enjoy --algo {ALGO} --env {ENV} -f logs\n" in text
    assert "(limit 22)" in text
    assert f"| trained for | {STEPS} agent steps |" in text
    assert "![learning.png](learning.png)" in text


# its argument is the other class's, too, which is dropped
PID = {"multipliers_class": "PIDMultipliers", "multipliers_kwargs": {"initial": 0.0}}


def parameters_of(command):
    """What ``train`` makes of the flags ``--preset`` and ``-params`` of a command line."""
    words = shlex.split(command)
    presets = words[words.index("--preset") + 1].split(",") if "--preset" in words else []
    parser = push.ConsoleParser()
    parser.add_argument("-params", nargs="+", action=StoreDict)
    rest = words[words.index("-params") :] if "-params" in words else []
    return presets, parser.parse_args(rest).params or {}


@pytest.mark.parametrize(
    ("algo", "presets", "overrides"),
    [
        ("e2c_t", [], {}),
        ("e2c", ["gru", "pure"], {"n_epochs": 3, "learning_rate": "lin_1e-4"}),
        ("mappo", [], {"policy_kwargs": {"net_arch": [8, 8]}, "normalize": {"clip_obs": 5.0}}),
        ("c_mappo", [], {"multipliers_class": "PIDMultipliers", "cost_gamma": None}),
        ("c_mappo", [], PID),
        ("e2c_t", [], {"oem_kwargs": {"estimator": "visit_count", "psi": None}}),
    ],
)
def test_the_command_on_the_card_trains_with_the_same_configuration(algo, presets, overrides):
    config = resolve(algo, ENV, presets, overrides)
    run = Run(algo, ENV, Path(), Path(), config)
    command = card.train_command(run, {"preset": ",".join(presets) or "headline", "seed": 7})
    words = command.split()
    assert words[:8] == f"sb3-e2c train --algo {algo} --env {ENV} --seed 7".split()
    found_presets, parameters = parameters_of(command)
    assert found_presets == presets
    assert resolve(algo, ENV, found_presets, parameters) == config


@pytest.mark.parametrize(
    ("args", "sentence"),
    [
        ({"trained_agent": "a.zip"}, "It went on from another model"),
        ({"opponent": "b.zip"}, "It was trained against a saved adversary"),
        ({"eval_env_kwargs": {"a": 1}}, "it was evaluated in a changed environment"),
    ],
)
def test_the_card_says_what_the_command_leaves_out(published, args, sentence):
    config = resolve(ALGO, ENV)
    results = json.loads((published / "results.json").read_text())
    run = Run(ALGO, ENV, Path(), Path(), config)
    assert sentence in card.model_card(run, args, results, "me/team", [])
    assert sentence not in card.model_card(run, {}, results, "me/team", [])


def test_another_model_of_the_run_can_be_published(trained, tmp_path):
    out = tmp_path / "team"
    run_push(trained, "--folder-only", out, "--load-checkpoint", STEPS, "--no-render")
    assert json.loads((out / "results.json").read_text())["model"] == f"rl_model_{STEPS}_steps.zip"
    assert {path.name for path in out.iterdir()} == TEAM - {"replay.mp4"}
    assert f"--repo-id USER/{ALGO}-{ENV} " in (out / "README.md").read_text()


def test_a_folder_with_something_else_in_it_is_left_alone(trained, tmp_path, capsys):
    (tmp_path / "README.md").write_text("mine")
    line = refusal(
        capsys, "push", "--algo", ALGO, "--env", ENV, "-f", trained, "--folder-only", tmp_path
    )
    assert "README.md" in line
    assert (tmp_path / "README.md").read_text() == "mine"


def test_a_run_that_does_not_exist_leaves_no_folder(tmp_path, capsys):
    out = tmp_path / "team"
    assert "sb3-e2c train" in refusal(capsys, "push", "-f", tmp_path, "--folder-only", out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "push needs --repo-id USER/NAME, or --folder-only OUT"),
        (["--repo-id", "rovers"], "'rovers'; expected USER/NAME"),
        (["--repo-id", "me/ro vers"], "'me/ro vers'; expected USER/NAME"),
        (["--repo-id", "me/../you"], "expected USER/NAME"),
    ],
)
def test_a_mistake_in_push_is_one_line(trained, capsys, flags, message):
    assert message in refusal(capsys, "push", "--algo", ALGO, "--env", ENV, "-f", trained, *flags)


# ---------------------------------------------------------------------------- there and back


def test_what_was_published_evaluates_to_the_same_numbers(server, trained, tmp_path, capsys):
    run_push(trained, "--repo-id", "me/team", "--private", "-m", "Predators", "--no-render")
    assert capsys.readouterr().out.splitlines() == [f"{server.endpoint}/me/team", "hub/team"]
    assert server.private == {"me/team": True}
    assert server.messages == ["Predators"]
    logs = tmp_path / "elsewhere"
    cli.main(["load", "--repo-id", "me/team", "-f", str(logs)])
    run = logs / ALGO / f"{ENV}_1"
    assert str(run) in capsys.readouterr().out
    here, there = (run_enjoy(each, tmp_path / "out.json") for each in (trained, logs))
    assert numbers(here) == numbers(there)
    assert here["team_return"] == json.loads((run / "results.json").read_text())["team_return"]
    assert [path.name for path in logs.iterdir()] == [ALGO]  # nothing temporary is left


def test_a_second_upload_leaves_no_file_of_the_first(server, published):
    server.repos["me/team"] = {"LICENSE": b"MIT", "replay.mp4": b"old", "config.yml": b"old"}
    folder = shutil.copytree(published, Path("copy"))
    (folder / "replay.mp4").unlink()
    push.upload(folder, "me/team", private=False, message="Again")
    assert server.repos["me/team"].keys() == TEAM - {"replay.mp4"} | {"LICENSE"}
    assert server.repos["me/team"]["config.yml"] == (published / "config.yml").read_bytes()


@pytest.mark.parametrize("trouble", ["no token", "wrong token", "no network"])
def test_an_upload_that_fails_says_where_the_folder_is(
    server, published, monkeypatch, trouble, tmp_path
):
    if trouble == "no token":
        monkeypatch.setattr(push, "get_token", lambda: None)
    elif trouble == "wrong token":
        monkeypatch.setenv("HF_TOKEN", "hf_other")
    else:
        monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(UserError, match=f"; the folder is ready in {published}$"):
        push.upload(published, "me/team", private=False, message="")
    assert server.repos == {}


# ---------------------------------------------------------------------------- what is fetched


@pytest.fixture
def repository(server, published):
    """The files of a repository with the team, to be spoiled."""
    server.repos["me/team"] = {path.name: path.read_bytes() for path in published.iterdir()}
    return server.repos["me/team"]


def run_load(*flags):
    cli.main(["load", "--repo-id", "me/team", "--verbose", "0", *flags])


def test_a_loaded_team_is_the_next_run(repository):
    taken = Path("logs", ALGO, f"{ENV}_4")
    (taken / ENV).mkdir(parents=True)
    (taken / "mine").write_text("mine")
    run_load()
    run_load()
    assert [path.name for path in taken.iterdir()] == [ENV, "mine"] or (taken / "mine").exists()
    loaded = Path("logs", ALGO, f"{ENV}_5")
    files = {str(path.relative_to(loaded)) for path in loaded.rglob("*") if path.is_file()}
    assert files == {
        *(f"{ENV}.zip", f"{ENV}.adversary.zip", f"{ENV}.vecnormalize.npz"),
        *(f"{ENV}/config.yml", f"{ENV}/args.yml"),
        *("README.md", "results.json", "learning.png", "replay.mp4"),
    }
    assert Path("logs", ALGO, f"{ENV}_6").is_dir()


def test_a_run_that_appears_meanwhile_is_not_overwritten(repository, monkeypatch):
    monkeypatch.setattr(load, "latest_run_id", lambda *_: 0)
    taken = Path("logs", ALGO, f"{ENV}_1")
    taken.mkdir(parents=True)
    (taken / "mine").write_text("mine")
    run_load()
    assert [path.name for path in taken.iterdir()] == ["mine"]
    assert Path("logs", ALGO, f"{ENV}_2", f"{ENV}.zip").is_file()


def test_a_revision_can_be_named_and_is_noted(server, repository):
    run_load("--revision", "v1.0")
    assert server.revisions == ["v1.0"]
    noted = read_yaml(Path("logs", ALGO, f"{ENV}_1", ENV, "args.yml"))
    assert (noted["repo_id"], noted["revision"]) == ("me/team", _Answers.sha)


def test_other_files_stay_on_the_hub(server, repository):
    repository["vecnormalize.pkl"] = pickle.dumps("anything")
    repository["sub/model.zip"] = b"anything"
    run_load()
    assert set(server.served) == TEAM
    assert not list(Path("logs").rglob("*.pkl"))


def test_a_callback_in_the_configuration_is_left_out(repository):
    config = yaml.safe_load(repository["config.yml"])
    repository["config.yml"] = yaml.safe_dump({**config, "callback": "os.system"}).encode()
    run_load()
    assert read_yaml(Path("logs", ALGO, f"{ENV}_1", ENV, "config.yml")) == config


def archive_of(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def claiming_size(n_floats):
    """A file of statistics whose array claims more numbers than there are."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f8", "fortran_order": False, "shape": (n_floats,)}
    )
    return archive_of(**{"obs_rms.mean.npy": file.getvalue()})


def array_of_objects():
    file = io.BytesIO()
    np.savez(file, mean=np.array([{}]))
    return file.getvalue()


_ALIASES = b"a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]\n"
_ZEROS = bytes(2**20)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("../../evil.py", b"", "'../../evil.py' would lie outside of the folder"),
        ("/etc/evil", b"", "would lie outside of the folder"),
        ("..\\evil", b"", "would lie outside of the folder"),
        ("C:evil", b"", "would lie outside of the folder"),
        ("model.zip", None, "it has no model.zip; expected a team that sb3-e2c push has written"),
        ("args.yml", None, "it has no args.yml"),
        ("model.zip", b"no zip", "model.zip: File is not a zip file"),
        ("model.zip", archive_of(**{"../policy.pth": b""}), "'../policy.pth', which would unpack"),
        ("model.adversary.zip", b"", "model.adversary.zip: File is not a zip file"),
        ("model.vecnormalize.npz", b"PK", "model.vecnormalize.npz: File is not a zip"),
        ("model.vecnormalize.npz", claiming_size(2**58), "model.vecnormalize.npz is damaged"),
        ("model.vecnormalize.npz", archive_of(**{"a.npy": pickle.dumps(1)}), "'a' is no array"),
        ("model.vecnormalize.npz", array_of_objects(), "Object arrays cannot be loaded"),
        ("config.yml", _ALIASES, "config.yml has aliases, or more than 20 levels"),
        ("config.yml", b"[" * 60_000, "config.yml has aliases, or more than 20 levels"),
        ("config.yml", b"[" * 9 + b"}", "cannot read config.yml"),
        ("config.yml", b"a: \xff", "config.yml is damaged"),
        ("config.yml", b"- 1", "expected a YAML mapping"),
        ("config.yml", b"n_epochz: 1", "policy is missing"),
        ("config.yml", b"!!python/object/apply:os.system [ls]", "cannot read"),
        ("args.yml", b"{algo: e2c_t, env: ../../x, seed: 1}", "unknown environment"),
        ("args.yml", b"{algo: e2c_x, env: PredatorPrey-v0}", "did you mean 'e2c_t'?"),
        ("args.yml", b"{algo: e2c_t, env: PredatorPrey-v0, seed: [1]}", "seed is [1]"),
        ("results.json", bytes(2**20 + 1), "results.json has 1,048,577 bytes; expected at most"),
    ],
)
def test_what_no_team_has_is_refused_and_leaves_no_run(repository, capsys, name, content, message):
    if content is None:
        del repository[name]
    else:
        repository[name] = content
    line = refusal(capsys, "load", "--repo-id", "me/team")
    assert message in line
    assert line.startswith("sb3-e2c: error: cannot load me/team: ")
    assert not list(Path().rglob("logs/*"))


@pytest.mark.parametrize(
    "bomb",
    [
        archive_of(**{"policy.pth": archive_of(a=_ZEROS, b=_ZEROS), "data": b"{}"}),
        archive_of(data=_ZEROS, more=_ZEROS),
    ],
    ids=["within a model's weights", "in the model's file"],
)
def test_a_zip_bomb_is_refused(repository, capsys, monkeypatch, bomb):
    monkeypatch.setitem(hub.LARGEST, "model.zip", 2**20)
    repository["model.zip"] = bomb
    line = refusal(capsys, "load", "--repo-id", "me/team")
    assert "unpacks to 2,097,152 bytes; expected at most 1,048,576" in line


def test_a_member_cannot_unpack_to_more_than_it_claims(repository, capsys):
    """An archive that understates the size of a member."""
    content = archive_of(**{"policy.pth": archive_of(a=_ZEROS)})
    true, claimed = (struct.pack("<L", size) for size in (len(archive_of(a=_ZEROS)), 22))
    repository["model.zip"] = content.replace(true, claimed)
    assert "cannot load me/team: model.zip: " in refusal(capsys, "load", "--repo-id", "me/team")


def test_sizes_are_checked_before_anything_is_fetched(server, repository, capsys):
    server.lies["model.zip"] = 2**40
    line = refusal(capsys, "load", "--repo-id", "me/team")
    assert "model.zip has 1,099,511,627,776 bytes; expected at most 1,073,741,824" in line
    assert server.served == []


def test_sizes_are_checked_again_when_files_have_arrived(tmp_path):
    (tmp_path / "config.yml").write_bytes(bytes(2**16 + 1))
    with pytest.raises(UserError, match=r"config.yml has 65,537 bytes"):
        load.check_files(tmp_path, ["config.yml"])


def test_a_link_is_no_file(tmp_path):
    (tmp_path / "README.md").symlink_to(__file__)
    with pytest.raises(UserError, match=r"README.md has not arrived as a file"):
        load.check_files(tmp_path, ["README.md"])


class _Payload:
    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def test_no_pickle_in_a_loaded_team_is_executed(repository, tmp_path):
    payload = base64.b64encode(pickle.dumps(_Payload())).decode()
    with zipfile.ZipFile(io.BytesIO(repository["model.zip"])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    serialized = [value for value in data.values() if isinstance(value, dict)]
    for value in serialized:
        value[":serialized:"] = payload
    assert serialized
    repository["model.zip"] = archive_of(**{**members, "data": json.dumps(data)})
    run_load()
    run_enjoy("logs", tmp_path / "out.json")
    assert not Path("executed").exists()
    pickle.loads(base64.b64decode(payload))
    assert Path("executed").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--repo-id", "me/nothing"], "cannot load me/nothing: 404"),
        (["--repo-id", "team"], "'team'; expected USER/NAME"),
        ([], "--repo-id"),
    ],
)
def test_a_mistake_in_load_is_one_line(server, capsys, flags, message):
    assert message in refusal(capsys, "load", *flags)


def test_loading_without_a_network_is_one_line(server, capsys, monkeypatch):
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert "cannot load me/team: " in refusal(capsys, "load", "--repo-id", "me/team")
