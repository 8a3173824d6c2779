"""Fetch a team from the Hugging Face hub: ``sb3-e2c load --repo-id USER/NAME -f logs``.

It becomes the next run of its method and task in the log folder, for sb3-e2c enjoy, record and
export. Only files of known names and bounded sizes are fetched, and nothing in them is executed.
"""

import hashlib
import sys
import tempfile
import time
import zipfile
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from huggingface_hub import HfApi, hf_hub_url
from huggingface_hub.hf_api import ModelInfo, RepoSibling
from huggingface_hub.utils import build_hf_headers, get_session, hf_raise_for_status

from sb3_e2c.zoo.archives import check_archive, is_inside
from sb3_e2c.zoo.configuration import check, check_algo, check_env, read_yaml
from sb3_e2c.zoo.console import (
    ConsoleParser,
    UserError,
    brief,
    check_writable,
    one_line_errors,
    write_whole,
)
from sb3_e2c.zoo.hub import LARGEST, MODEL, NEEDED, check_repo_id, hub_errors
from sb3_e2c.zoo.push import PUBLIC_ARGS, plain_yaml
from sb3_e2c.zoo.runs import latest_run_id

_CONFIGURATION = ("config.yml", "args.yml")
_DEEPEST = 20  # levels of YAML
_SILENCE = 20.0  # seconds until a server that says nothing is given up
_PATIENCE, _SLOWEST = 30.0, 1024  # seconds at the start; bytes a second on average after them
_OPENING = (
    *(yaml.BlockMappingStartToken, yaml.BlockSequenceStartToken),
    *(yaml.FlowMappingStartToken, yaml.FlowSequenceStartToken),
)
_CLOSING = (yaml.BlockEndToken, yaml.FlowMappingEndToken, yaml.FlowSequenceEndToken)
_PLAIN = (str, int, float, bool, type(None))


def make_parser() -> ConsoleParser:
    """The flags of ``load``."""
    parser = ConsoleParser(
        prog="sb3-e2c load",
        description=(__doc__ or "").split("\n\n")[1],
        examples=["sb3-e2c load --repo-id me/rovers -f logs"],
    )
    add = parser.add_argument
    add("--repo-id", required=True, metavar="USER/NAME", help="repository on the hub")
    add("--revision", metavar="REV", help="branch, tag or commit there (default: main)")
    add("-f", "--folder", type=Path, default=Path("logs"), help="log folder (default: logs)")
    add("--verbose", type=int, default=1, help="0: print nothing")
    return parser


def load(args: Namespace) -> Path:
    """Fetch a team into the log folder.

    :param args: See :func:`make_parser`
    :return: The folder of the run
    :raises UserError: if there is no such team, or it is none that ``push`` could have written
    """
    check_repo_id(args.repo_id)
    check_writable(args.folder, "--folder")
    fetched_from = f"cannot load {args.repo_id}"
    with hub_errors(fetched_from):
        info = HfApi().model_info(
            args.repo_id, revision=args.revision, files_metadata=True, timeout=_SILENCE
        )
    try:
        names = files_of_a_team(info)
        args.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".load-", dir=args.folder) as temporary:
            place = Path(temporary)
            listed = {file.rfilename: file for file in info.siblings or []}
            (place / "hub").mkdir()
            for name in names:
                with hub_errors(f"download of {name}"):
                    fetch(args.repo_id, info.sha, listed[name], place / "hub" / name)
            check_files(place / "hub", names)
            source = {"repo_id": args.repo_id, "revision": info.sha}
            return _arrange(place / "hub", place / "run", names, args.folder, source)
    except UserError as error:
        raise UserError(f"{fetched_from}: {error}") from error


# ---------------------------------------------------------------------------- what is fetched


def files_of_a_team(info: ModelInfo) -> list[str]:
    """Names of the files to be fetched from a repository; others stay there.

    :param info: Its list of files
    :raises UserError: if it lists what no team has
    """
    sizes = {file.rfilename: file.size for file in info.siblings or []}
    for name in sizes:
        if not is_inside(name):
            raise UserError(f"its file {name!r} would lie outside of the folder")
    missing = [name for name in NEEDED if name not in sizes]
    if missing:
        raise UserError(f"it has no {missing[0]}; expected a team that sb3-e2c push has written")
    names = [name for name in LARGEST if name in sizes]
    for name in names:
        _check_size(name, sizes[name])
    return names


def fetch(repo_id: str, revision: str | None, file: RepoSibling, path: Path) -> None:
    """Download a file, but no more, and nothing else, than its repository lists.

    The hub's own client would wait for ever for a server that breaks off again and again.

    :param repo_id: The repository
    :param revision: Its commit
    :param file: What the hub lists: name, size, and a checksum
    :param path: Where it shall lie
    :raises UserError: if something else arrives, or hardly anything
    """
    size, start = file.size or 0, time.monotonic()
    url, headers = hf_hub_url(repo_id, file.rfilename, revision=revision), build_hf_headers()
    options: dict[str, Any] = {"follow_redirects": True, "timeout": _SILENCE}
    hashes = {"sha256": hashlib.sha256(), "git": hashlib.sha1(b"blob %d\0" % size)}
    with (
        get_session().stream("GET", url, headers=headers, **options) as answer,
        path.open("wb") as to,
    ):
        hf_raise_for_status(answer)
        for chunk in answer.iter_bytes():
            to.write(chunk)
            for each in hashes.values():
                each.update(chunk)
            if to.tell() > size:
                raise UserError(f"more arrives than the {size:,} bytes that are listed")
            if time.monotonic() - start > _PATIENCE + to.tell() / _SLOWEST:
                raise UserError(f"it arrives at less than {_SLOWEST} bytes a second; try later")
    _check_arrived(file, path.stat().st_size, {k: v.hexdigest() for k, v in hashes.items()})


def _check_arrived(file: RepoSibling, size: int, found: Mapping[str, str]) -> None:
    if size != file.size:
        raise UserError(f"{size:,} of {file.size:,} bytes have arrived; try again")
    kind, listed = ("sha256", file.lfs.sha256) if file.lfs else ("git", file.blob_id)
    if listed is not None and listed != found[kind]:
        raise UserError(f"its checksum is {found[kind]}, but {listed} is listed; try again")


def _check_size(name: str, size: int | None) -> None:
    if not isinstance(size, int) or not 0 <= size <= LARGEST[name]:
        found = f"{size:,}" if isinstance(size, int) else "an unknown number of"
        raise UserError(f"{name} has {found} bytes; expected at most {LARGEST[name]:,}")


def check_files(folder: Path, names: Sequence[str]) -> None:
    """Refuse files that are not what their names and sizes promise.

    :param folder: Where they are
    :param names: Their names
    :raises UserError: naming the first such file
    """
    for name in names:
        path = folder / name
        if path.is_symlink() or not path.is_file():
            raise UserError(f"{name} has not arrived as a file")
        _check_size(name, path.stat().st_size)
        if path.suffix in (".zip", ".npz"):
            try:
                check_archive(path, LARGEST[name])
                if path.suffix == ".zip":
                    _check_model(path)
            except Exception as error:  # whatever zip files raise for broken content
                raise UserError(f"{name}: {brief(error)}") from error
    statistics = folder / "model.vecnormalize.npz"
    if statistics.name in names:
        _check_numbers(statistics)


def _check_model(path: Path) -> None:
    """Of a file that was cut off, an archive inside it may be left."""
    with zipfile.ZipFile(path) as archive:
        missing = {"data", "policy.pth"} - set(archive.namelist())
    if missing:
        raise ValueError(f"it has no {sorted(missing)[0]}, as a saved model has")


def _check_numbers(path: Path) -> None:
    """Read the statistics once: an array may claim any size."""
    try:
        with np.load(path, allow_pickle=False) as file:
            strangers = [key for key, value in file.items() if not isinstance(value, np.ndarray)]
    except (OSError, ValueError, EOFError, KeyError, MemoryError, zipfile.BadZipFile) as error:
        raise UserError(f"{path.name} is damaged: {brief(error)}") from error
    if strangers:
        raise UserError(f"{path.name} is damaged: {strangers[0]!r} is no array")


# ---------------------------------------------------------------------------- the run folder


def _arrange(
    hub: Path, run: Path, names: Sequence[str], logs: Path, source: Mapping[str, Any]
) -> Path:
    """Lay the files out as ``train`` does, and make that the next run.

    :return: The folder of the run
    """
    config, trained_with = (_read_untrusted(hub / name) for name in _CONFIGURATION)
    algo, env_id = _check_configuration(config, trained_with)
    for name in names:
        if name not in _CONFIGURATION:
            new = name.replace(MODEL.removesuffix("zip"), f"{env_id}.", 1)
            run.mkdir(exist_ok=True)
            (hub / name).replace(run / new)
    known = {name: trained_with[name] for name in PUBLIC_ARGS if name in trained_with}
    write_whole(run / env_id / "config.yml", plain_yaml(config))
    write_whole(run / env_id / "args.yml", plain_yaml({**known, **source}))
    return _next_run(run, logs / algo, env_id)


def _read_untrusted(path: Path) -> dict[str, Any]:
    """A mapping from YAML without what makes a few lines stand for gigabytes, or take hours."""
    depth = 0
    try:
        for token in yaml.scan(path.read_text()):
            depth += isinstance(token, _OPENING) - isinstance(token, _CLOSING)
            if isinstance(token, yaml.AliasToken) or depth > _DEEPEST:
                raise UserError(
                    f"{path.name} has aliases, or more than {_DEEPEST} levels; expected plain YAML"
                )
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path.name} is damaged: {brief(error)}") from error
    try:
        return read_yaml(path)
    except UserError as error:  # without the temporary folder's name
        raise UserError(str(error).replace(str(path), path.name)) from error


def _check_configuration(config: dict[str, Any], args: dict[str, Any]) -> tuple[str, str]:
    """Refuse what no run has; returns method and task."""
    for name in PUBLIC_ARGS:
        if not isinstance(args.get(name), _PLAIN):
            raise UserError(f"args.yml: {name} is {brief(repr(args[name]))}; expected plain data")
    algo, env_id = str(args.get("algo")), str(args.get("env"))
    check_algo(algo)
    check_env(env_id)
    config.pop("callback", None)  # names code, for training only
    check(algo, config)
    return algo, env_id


def _next_run(run: Path, logs: Path, env_id: str) -> Path:
    """Rename a folder to that of the next run; another process may take a number first."""
    logs.mkdir(parents=True, exist_ok=True)
    for target in _targets(logs, env_id):
        try:
            return run.rename(target)
        except OSError:
            if not target.exists():
                raise
    raise AssertionError("there is always a next number")


def _targets(logs: Path, env_id: str) -> Iterator[Path]:
    number = latest_run_id(logs, env_id)
    while True:
        number += 1
        yield logs / f"{env_id}_{number}"


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c load``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        run = load(args)
        if args.verbose > 0:
            trained_with = read_yaml(next(run.glob("*/args.yml")))
            algo, env_id, number = run.parent.name, trained_with["env"], run.name.rpartition("_")[2]
            print(run)
            print(f"sb3-e2c enjoy --algo {algo} --env {env_id} -f {args.folder} --exp-id {number}")


if __name__ == "__main__":
    main()
