"""Archives from strangers: looked at before anything in them is unpacked."""

import stat
import zipfile
from pathlib import Path, PurePosixPath
from typing import IO


def check_archive(path: str | Path, largest: int) -> None:
    """Refuse a zip file that would unpack to too much or elsewhere, and what torch has in it.

    Neither Python nor torch unpacks more of a member than the size that is added up here.

    :param path: A model's .zip, or an .npz
    :param largest: Most bytes that it, and each .pth in it, may unpack to
    :raises ValueError: if it does; without the file's name
    :raises Exception: whatever zip files raise for broken content
    """
    with open(path, "rb") as file:
        _check("it", file, largest)


def _check(name: str, file: IO[bytes], largest: int) -> None:
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        unpacked = sum(member.file_size for member in members)
        if unpacked > largest:
            raise ValueError(f"{name} unpacks to {unpacked:,} bytes; expected at most {largest:,}")
        for member in members:
            if not is_inside(member.filename) or stat.S_ISLNK(member.external_attr >> 16):
                raise ValueError(f"{name} has {member.filename!r}, which would unpack elsewhere")
            if member.filename.endswith(".pth"):
                with archive.open(member) as inner:
                    _check(member.filename, inner, largest)


def is_inside(name: str) -> bool:
    """Whether a name from a list or an archive stays in the folder that it is put in.

    :param name: With "/" between folders
    """
    path = PurePosixPath(name)
    return not (path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name)
