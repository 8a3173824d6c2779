"""Publish a trained team on the Hugging Face hub: ``sb3-e2c push --repo-id USER/NAME``.

Evaluates and films the team, and writes a folder: weights, configuration, statistics of the
observations, results, learning curve, film and model card. Then uploads it; sb3-e2c load brings the
team back.
"""

import json
import platform
import shutil
import sys
import zipfile
from argparse import Namespace
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import HfApi, get_token

from sb3_e2c.opponents import adversary_path
from sb3_e2c.zoo import enjoy, record
from sb3_e2c.zoo.card import model_card
from sb3_e2c.zoo.configuration import read_yaml
from sb3_e2c.zoo.console import (
    ConsoleParser,
    UserError,
    check_writable,
    one_line_errors,
    write_whole,
)
from sb3_e2c.zoo.curves import plot_learning
from sb3_e2c.zoo.hub import (
    CARD,
    CURVE,
    FILM,
    LARGEST,
    MODEL,
    RESULTS,
    check_repo_id,
    hub_errors,
)
from sb3_e2c.zoo.normalization import statistics_path
from sb3_e2c.zoo.runs import Run, add_run_flags, add_seed_flag, find_run

# Of args.yml; the other flags are folders, accounts and files of one machine.
PUBLIC_ARGS = ("algo", "env", "seed", "n_timesteps", "preset")
_PACKAGES = ("sb3_e2c", "stable_baselines3", "torch", "numpy")


def make_parser() -> ConsoleParser:
    """The flags of ``push``."""
    parser = ConsoleParser(
        prog="sb3-e2c push",
        description=(__doc__ or "").split("\n\n")[1],
        examples=[
            "sb3-e2c push --algo e2c_t --env MultiRover-6-3-v0 -f logs --repo-id me/rovers",
            "sb3-e2c push --algo e2c_t --env MultiRover-6-3-v0 -f logs --folder-only rovers",
        ],
    )
    add = parser.add_argument
    add_run_flags(parser)
    add("--repo-id", metavar="USER/NAME", help="repository on the hub; made if there is none")
    add("--private", action="store_true", help="if it is made: only you can see it")
    add("-m", "--commit-message", default="Upload a team", metavar="MSG", help="message there")
    add(
        "--folder-only",
        type=Path,
        metavar="OUT",
        help="write the folder OUT and upload nothing (default: hub/NAME, and upload it)",
    )
    add("--n-episodes", type=int, default=100, help="episodes of the evaluation (default: 100)")
    add("--n-envs", type=int, default=10, help="worlds at a time (default: 10)")
    add_seed_flag(parser)
    add("--device", default="auto", help="torch device (default: auto)")
    add("--no-render", action="store_true", help="no film, as with RL-Zoo")
    add("--verbose", type=int, default=1, help="0: print nothing")
    return parser


def push(args: Namespace) -> Path:
    """Write the folder, and upload it unless told not to.

    :param args: See :func:`make_parser`
    :return: The folder
    :raises UserError: if it cannot be made or uploaded
    """
    if args.repo_id is not None:
        check_repo_id(args.repo_id)
    elif args.folder_only is None:
        raise UserError("push needs --repo-id USER/NAME, or --folder-only OUT")
    run = find_run(args)
    repo_id = args.repo_id or f"USER/{run.algo}-{run.env_id}"
    folder = args.folder_only or Path("hub", repo_id.split("/")[1])
    _check_folder(folder)
    write_folder(run, args, folder, repo_id)
    if args.folder_only is None:
        url = upload(folder, repo_id, args.private, args.commit_message)
        _say(args, url)
    return folder


def _check_folder(folder: Path) -> None:
    """Refuse a folder with anything in it that an earlier push has not written."""
    check_writable(folder, "--folder-only")
    found = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    foreign = sorted(found - LARGEST.keys()) or (MODEL not in found and sorted(found))
    if foreign:
        raise UserError(
            f"{folder} holds {foreign[0]}; expected a new folder, or one that push has written"
        )


def _say(args: Namespace, *lines: object) -> None:
    if args.verbose > 0:
        print(*lines, sep="\n")


# ---------------------------------------------------------------------------- the folder


def write_folder(run: Run, args: Namespace, folder: Path, repo_id: str) -> None:
    """Write everything that is published.

    :param run: The run
    :param args: See :func:`make_parser`
    :param folder: Where; what an earlier call has left is replaced
    :param repo_id: Where it will be on the hub
    """
    results = evaluate(run, args)  # first: a run that cannot be evaluated leaves no folder
    folder.mkdir(parents=True, exist_ok=True)
    for name in LARGEST:
        (folder / name).unlink(missing_ok=True)
    _copy_model(run, folder / MODEL)
    trained_with = read_yaml(run.folder / run.env_id / "args.yml")
    public = {name: trained_with[name] for name in PUBLIC_ARGS if name in trained_with}
    write_whole(folder / "config.yml", plain_yaml(run.config))
    write_whole(folder / "args.yml", plain_yaml(public))
    write_whole(folder / RESULTS, json.dumps(results, indent=2) + "\n")
    pictures = _draw(run, args, folder)
    write_whole(folder / CARD, model_card(run, trained_with, results, repo_id, pictures))


def evaluate(run: Run, args: Namespace) -> dict[str, Any]:
    """What becomes results.json: see :func:`sb3_e2c.zoo.enjoy.summarize`, with sampled actions.

    :param run: The run
    :param args: See :func:`make_parser`
    """
    flags = {**vars(enjoy.make_parser().parse_args([])), **vars(args), "verbose": 0}
    results = enjoy.enjoy(Namespace(**flags))
    results.pop("against", None)  # its own adversary only: the same numbers again
    versions = {name: metadata.version(name) for name in _PACKAGES}
    return {
        **results,
        "model": run.model_path.name,
        "trained_steps": _trained_steps(run.model_path),
        "versions": {"python": platform.python_version(), **versions},
    }


def _trained_steps(model: Path) -> int:
    with zipfile.ZipFile(model) as archive:
        return int(json.loads(archive.read("data"))["num_timesteps"])


def _copy_model(run: Run, model: Path) -> None:
    """The weights, and what belongs beside them; statistics as numbers, not as a pickle."""
    shutil.copyfile(run.model_path, model)
    for beside in (adversary_path, statistics_path):
        if beside(run.model_path).is_file():
            shutil.copyfile(beside(run.model_path), beside(model))


def plain_yaml(content: Mapping[str, Any]) -> str:
    """YAML without anchors and aliases, which ``load`` refuses.

    :param content: Plain data
    """
    return yaml.dump(dict(content), Dumper=_NoAliases)


class _NoAliases(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - the signature is PyYAML's
        """Write everything out."""
        return True


def _draw(run: Run, args: Namespace, folder: Path) -> list[str]:
    """Learning curve and film, where they can be made.

    :return: The pictures among them
    """
    pictures = []
    try:
        pictures.append(plot_learning(run.folder, folder / CURVE).name)
    except UserError as error:  # for instance a run that was downloaded: it has no log
        _say(args, f"No learning curve: {error}")
    if not args.no_render:
        flags = {**vars(record.make_parser().parse_args(["-o", FILM])), **vars(args)}
        try:
            record.record(Namespace(**{**flags, "out": folder / FILM, "n_episodes": 1}))
        except UserError as error:  # for instance a machine without graphics
            _say(args, f"No film: {error}")
    return pictures


# ---------------------------------------------------------------------------- the hub


def upload(folder: Path, repo_id: str, private: bool, message: str) -> str:
    """Bring the folder to the hub; files of an earlier upload that it has no more are deleted.

    :param folder: What :func:`write_folder` wrote
    :param repo_id: Where to
    :param private: If the repository is made: whether only its owner can see it
    :param message: Of the commit
    :return: The address
    :raises UserError: if the hub cannot be reached, or refuses
    """
    here = f"; the folder is ready in {folder}"
    if get_token() is None:
        raise UserError(f"no token of the Hugging Face hub: hf auth login, or set HF_TOKEN{here}")
    names = list(LARGEST)
    api = HfApi(library_name="sb3-e2c")
    with hub_errors(f"cannot upload to {repo_id}", here):
        url = api.create_repo(repo_id, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            commit_message=message,
            allow_patterns=names,
            delete_patterns=names,
        )
    return str(url)


def main(argv: Sequence[str] | None = None) -> None:
    """Console command ``sb3-e2c push``.

    :param argv: Flags; default: those of this process
    """
    args = make_parser().parse_args(sys.argv[1:] if argv is None else argv)
    with one_line_errors():
        _say(args, push(args))


if __name__ == "__main__":
    main()
