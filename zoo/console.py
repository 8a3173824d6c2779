"""What the commands share: one-line errors, ``key:value`` flags, files written whole or not."""

import argparse
import ast
import difflib
import os
import sys
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
    hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names)}"
    return UserError(f"unknown {what} {name!r}; {hint}")


def fail(error: object) -> NoReturn:
    """Say what is wrong in one line on stderr and exit with status 2."""
    print("sb3-e2c: error:", " ".join(str(error).split()), file=sys.stderr)
    raise SystemExit(2)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn a :class:`UserError` into one line and exit status 2."""
    try:
        yield
    except UserError as error:
        fail(error)


class ConsoleParser(argparse.ArgumentParser):
    """An argument parser that reports mistakes in one line."""

    def error(self, message: str) -> NoReturn:
        """See :func:`fail`."""
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
    """Raise :class:`UserError` for a device that torch does not know.

    :param device: For instance "auto", "cpu", "cuda:0"
    """
    try:
        th.device("cpu" if device == "auto" else device)
    except RuntimeError:
        raise UserError(f"--device is {device!r}; expected auto, cpu, cuda or cuda:0") from None


def check_writable(folder: str | Path, flag: str) -> None:
    """Raise :class:`UserError` unless the folder exists, or can be made, and can be written.

    :param folder: The folder
    :param flag: The flag that named it
    """
    existing = Path(folder).absolute()
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        raise UserError(
            f"{flag} {folder}: cannot write there ({existing} is not a writable folder)"
        )
