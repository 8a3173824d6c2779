"""What the commands share: one-line errors, ``key:value`` flags, files written whole or not."""

import argparse
import ast
import difflib
import re
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import torch as th

from sb3_e2c.saving import atomic_write

_WORDS = {"true": True, "false": False, "null": None}


class UserError(ValueError):
    """A mistake of the person at the keyboard: reported in one line, exit status 2."""


def unknown(what: str, name: str, known: Iterable[str]) -> UserError:
    """An error that suggests the nearest known name.

    :param what: What was looked up, for instance "algorithm"
    :param name: What was found
    :param known: What would have been accepted
    """
    names = sorted(known)
    close = [each for each in names if each.lower() == str(name).lower()]
    close = close or difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}?" if close else f"known: {brief(', '.join(names))}"
    return UserError(f"unknown {what} {name!r}; {hint}")


def brief(text: object) -> str:
    """Another library's message, or a list, as a part of our one line.

    :param text: What may have many lines
    """
    return textwrap.shorten(str(text), 300, placeholder=" ...")


def fail(error: object) -> NoReturn:
    """Say what is wrong in one line on stderr and exit with status 2."""
    print("sb3-e2c: error:", " ".join(str(error).split()), file=sys.stderr)
    raise SystemExit(2)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn a :class:`UserError`, or a disk that refuses, into one line and exit status 2."""
    try:
        yield
    except (UserError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        print("sb3-e2c: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


class ConsoleParser(argparse.ArgumentParser):
    """An argument parser that reports mistakes in one line, and whose help ends with examples.

    :param examples: Command lines, each with a comment if it needs one
    :param kwargs: As for ``ArgumentParser``
    """

    def __init__(self, *, examples: Sequence[str] = (), **kwargs: Any):
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        if examples:
            kwargs["epilog"] = "\n  ".join(["examples:", *examples])
        super().__init__(**kwargs)

    def error(self, message: str) -> NoReturn:
        """See :func:`fail`; an unknown flag gets the nearest one beside it."""
        stranger = re.match(r"unrecognized arguments: (-[^\s=]+)", message)
        if stranger:
            flags = self._option_string_actions
            close = difflib.get_close_matches(stranger[1], flags, n=1, cutoff=0.75)
            message += f"; did you mean {close[0]}?" if close else ""
        fail(message)


class StoreDict(argparse.Action):
    """RL-Zoo's ``key:value key:value`` flags, read as data; ``outer.inner:value`` nests."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Store the pairs as one dictionary."""
        result: dict[str, Any] = {}
        for pair in values or []:
            key, colon, text = str(pair).partition(":")
            if not colon or not key:
                parser.error(f"argument {option_string}: found {pair!r}, expected key:value")
            *outer, last = key.split(".")
            inner = result
            for name in outer:
                inner = inner.setdefault(name, {})
                if not isinstance(inner, dict):
                    parser.error(
                        f"argument {option_string}: found {pair}, but {name} is {inner!r} already"
                    )
            inner[last] = parse_value(text)
        setattr(namespace, self.dest, result)


def parse_value(text: str) -> Any:
    """Read a Python or YAML literal, ``dict(a=1)``, or else a plain string; nothing is executed.

    :param text: What stands behind the colon
    """
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    try:
        return _literal(ast.parse(text, mode="eval").body)
    except (ValueError, SyntaxError):
        return text


def _literal(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict":
        return {str(keyword.arg): _literal(keyword.value) for keyword in node.keywords}
    if isinstance(node, ast.List | ast.Tuple):
        return [_literal(element) for element in node.elts]
    return ast.literal_eval(node)


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a file so that readers never see a part of it.

    :param path: Where it shall be
    :param content: What it shall hold
    """
    with atomic_write(Path(path)) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def check_device(device: str) -> None:
    """Raise :class:`UserError` for a device that this machine has not.

    :param device: For instance "auto", "cpu", "cuda:0"
    """
    if re.fullmatch(r"auto|cpu|mps|cuda(:\d+)?", device) is None:
        raise UserError(f"--device is {device!r}; expected auto, cpu, cuda, cuda:0 or mps")
    kind, _, number = device.partition(":")
    found = {"cuda": th.cuda.device_count(), "mps": int(th.backends.mps.is_available())}
    if int(number or 0) >= found.get(kind, 1):
        raise UserError(f"--device is {device!r}, but torch finds {found[kind]} such GPUs; use cpu")


def check_writable(folder: str | Path, flag: str) -> None:
    """Raise :class:`UserError` unless the folder exists, or can be made, and can be written.

    Permissions do not say it all (root, read-only and special file systems): we try.

    :param folder: The folder
    :param flag: The flag that named it
    """
    if not str(folder):
        raise UserError(f"{flag} is empty; expected the name of a folder")
    try:
        existing = Path(folder).absolute()
        while not existing.exists():
            existing = existing.parent
        with tempfile.TemporaryDirectory(dir=existing):
            pass
    except OSError as error:
        raise UserError(f"{flag} {folder}: cannot write there ({error.strerror})") from None


def check_file(path: Path | None, flag: str) -> None:
    """Raise :class:`UserError` unless a file of that name can be written.

    :param path: The file, if one is asked for
    :param flag: The flag that named it
    """
    if path is None:
        return
    if path.is_dir():
        raise UserError(f"{flag} {path} is a folder; expected the name of a file")
    check_writable(path.parent, flag)
