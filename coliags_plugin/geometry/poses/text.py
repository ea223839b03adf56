"""Reads text pose files; tolerates byte order marks, any line ends and blank lines."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import text_lines

#: What readers of poses expect.
EXPECTED = "a text file of poses"
#: Bytes of a file read to recognise it.
_HEAD_BYTES = 65_536


def read_numbers(
    path: Path, count: int, expected: str, do: str, *, comments: bool = False
) -> list[tuple[int, list[float]]]:
    """Read rows of so many finite numbers, separated by commas or blanks, each with its line number.

    ``expected`` and ``do`` are for the error about an invalid line. Lines that begin with ``#`` may be comments.
    """
    rows: list[tuple[int, list[float]]] = []
    for number, line in text_lines(path, EXPECTED):
        words = _words(line)
        if not words or (comments and words[0].startswith("#")):
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != count or not np.all(np.isfinite(values)):
            raise InputError(f"{path}, line {number}: '{shortened(line)}'", expected, do)
        rows.append((number, values))
    if not rows:
        raise InputError(f"{path} holds no poses", f"one line of {count} numbers per frame")
    return rows


def count_first_numbers(path: Path) -> int | None:
    """Count of numbers in the first line of a text file that is not a comment; None if it holds anything else."""
    for line in head(path).decode("utf-8-sig", errors="replace").splitlines():
        words = _words(line)
        if not words or words[0].startswith("#"):
            continue
        try:
            return len([float(word) for word in words])
        except ValueError:
            return None
    return None


def head(path: Path) -> bytes:
    """The first bytes of a file; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""


@contextmanager
def prefixed_errors(place: str) -> Iterator[None]:
    """Prefix the message of an :class:`InputError` raised within the block by a place."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error.seen}", error.expected, error.do) from error


def shortened(line: str) -> str:
    """A line shortened for messages."""
    text = line.strip()
    return text if len(text) <= 60 else f"{text[:57]}..."


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[,\s]+", line) if word]
