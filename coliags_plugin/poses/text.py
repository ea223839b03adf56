"""Pose files that are text: tolerant of byte order marks, line ends and blank lines, and of nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError

#: How much of a file is looked at to recognise it.
_HEAD_BYTES = 65_536


def read_text(path: Path, expected: str = "a text file of poses") -> str:
    """The text of a file, UTF-8 with or without a byte order mark.

    Raises:
        InputError: It cannot be read, or is no text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}", expected) from error


def read_numbers(
    path: Path, count: int, expected: str, do: str, *, comments: bool = False
) -> list[tuple[int, list[float]]]:
    """Rows of finite numbers, separated by commas or blanks, each with the number of its line.

    Args:
        path: A text file.
        count: Numbers in a row.
        expected: What the message about a line that holds something else says would be right.
        do: What it says to do.
        comments: Pass over lines that begin with ``#``.

    Raises:
        InputError: The file cannot be read or holds no rows, or a line is none; naming the line.
    """
    rows: list[tuple[int, list[float]]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
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
    """How many numbers the first line of a text file holds, comments apart; None where that is no row of numbers."""
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
    """The beginning of a file; nothing where it is none."""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""


@contextmanager
def placed(place: str) -> Iterator[None]:
    """Put a place before what an :class:`InputError` from within the block has seen."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error.seen}", error.expected, error.do) from error


def shortened(line: str) -> str:
    """A line as a message shows it."""
    text = line.strip()
    return text if len(text) <= 60 else f"{text[:57]}..."


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[,\s]+", line) if word]
