"""A team on the Hugging Face hub: the names and largest sizes of its files, and its errors."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from huggingface_hub.utils import disable_progress_bars, validate_repo_id

from sb3_e2c.zoo.console import UserError, brief

MODEL, CARD, RESULTS = "model.zip", "README.md", "results.json"
CURVE, FILM = "learning.png", "replay.mp4"  # the hub plays a film of this name

_KIB, _MIB = 2**10, 2**20
# Everything that a team may consist of, with the most bytes that it may have. The adversary and the
# statistics have the names that they get beside a model of this name.
LARGEST = {
    MODEL: 1024 * _MIB,
    "model.adversary.zip": 1024 * _MIB,
    "model.vecnormalize.npz": 64 * _MIB,
    "config.yml": 64 * _KIB,
    "args.yml": 64 * _KIB,
    RESULTS: _MIB,
    CARD: _MIB,
    CURVE: 16 * _MIB,
    FILM: 256 * _MIB,
}
NEEDED = (MODEL, "config.yml", "args.yml")


def check_repo_id(repo_id: str) -> None:
    """Raise :class:`UserError` unless it has the form of a repository's name.

    :param repo_id: What ``--repo-id`` says
    """
    found = f"--repo-id is {repo_id!r}; expected USER/NAME"
    if re.fullmatch(r"[^/]+/[^/]+", repo_id) is None:
        raise UserError(found)
    try:
        validate_repo_id(repo_id)
    except ValueError as error:
        raise UserError(f"{found}: {brief(error)}") from None


@contextmanager
def hub_errors(what: str, advice: str = "") -> Iterator[None]:
    """Turn whatever happens between here and the hub into a :class:`UserError`.

    :param what: What was tried
    :param advice: What to do then
    """
    disable_progress_bars()
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # of the hub, of its client, or of the network below
        raise UserError(f"{what}: {brief(error)}{advice}") from error
