"""Fetch a team from the Hugging Face hub: ``sb3-e2c load --repo-id USER/NAME -f logs``.

It becomes the next run of its method and task in the log folder, for sb3-e2c enjoy, record and
export. Only files of known names and bounded sizes are fetched, and nothing in them is executed.
"""

import sys
import tempfile
import zipfile
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.hf_api import ModelInfo
from rl_zoo3.utils import get_latest_run_id

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

_CONFIGURATION = ("config.yml", "args.yml")
_DEEPEST = 20  # levels of YAML
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
        info = HfApi().model_info(args.repo_id, revision=args.revision, files_metadata=True)
    try:
        names = files_of_a_team(info)
        args.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".load-", dir=args.folder) as temporary:
            place = Path(temporary)
            with hub_errors("download"):
                snapshot_download(
                    args.repo_id, revision=info.sha, allow_patterns=names, local_dir=place / "hub"
                )
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


def _check_size(name: str, size: int | None) -> None:
    if size is None or size > LARGEST[name]:
        found = "an unknown number of" if size is None else f"{size:,}"
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
            except Exception as error:  # whatever zip files raise for broken content
                raise UserError(f"{name}: {brief(error)}") from error
    statistics = folder / "model.vecnormalize.npz"
    if statistics.name in names:
        _check_numbers(statistics)


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
    number = get_latest_run_id(str(logs), env_id)
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
