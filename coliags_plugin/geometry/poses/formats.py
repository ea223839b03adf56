"""Pose file formats (:data:`coliags_plugin.core.registry.pose_formats`): detection, writing, and parts of readers."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import refuse_existing
from coliags_plugin.core.registry import pose_formats
from coliags_plugin.core.text_files import encoding_of, shortened, text_lines, unreadable
from coliags_plugin.geometry.poses.trajectory import Trajectory


@dataclass(frozen=True)
class Format:
    """A pose file format."""

    name: str  # on the command line
    read: Callable[[Path], Trajectory]  # a file or folder
    write: Callable[[Path, Trajectory], None] | None  # replaces an existing one; None: the format is read-only
    recognise: Callable[[Path], bool] | None  # by content; None: another format recognises it
    unit: str = "units"  # of length; "units": the format defines none
    keeps: frozenset[str] = frozenset()  # further stored data: names, timestamps, intrinsics, cameras of each pose
    folder: bool = False  # a folder of files


def format_named(name: str) -> Format:
    """The format with a given name."""
    pose_format: Format = pose_formats.get(name)
    return pose_format


def format_of(path: Path, name: str | None = None) -> Format:
    """The format of an existing file or folder, by its name or, where that is None, by the content."""
    if not path.exists():
        raise InputError(f"no file or folder {path}", "poses")
    if name is not None:
        candidate = format_named(name)
        if path.is_dir() and not candidate.folder:
            raise InputError(f"{path} is a folder", f"the {candidate.name} file itself")
        return candidate
    for candidate in map(format_named, pose_formats):
        if candidate.recognise is not None and candidate.recognise(path):
            return candidate
    if path.is_dir():
        entries = sorted(entry.name for entry in path.iterdir())
        shown = ", ".join(entries[:3]) + (f" and {len(entries) - 3} more" if len(entries) > 3 else "")
        raise InputError(
            f"{path} holds {shown or 'nothing'}", "the folder of a COLMAP model, or a pose file inside a folder"
        )
    line, count = _first_row(path)
    raise unreadable(
        path,
        f"{path} has no known pose format: its first line holds "
        + (f"{count} numbers" if count is not None else "no row of numbers with decimal points")
        + (f": '{shortened(line)}'" if line else ""),
        "16 numbers per line (c3vd), 8 (tum), a params.npz (endogslam) or a transforms.json (nerfstudio)",
    )


def write_trajectory(path: Path, trajectory: Trajectory, name: str, overwrite: bool = False) -> None:
    """Write a trajectory atomically; the parent folder is made."""
    target = format_named(name)
    if target.write is None:
        writable = [other for other in pose_formats if format_named(other).write is not None]
        raise InputError(f"format '{name}' is read-only", f"one of {', '.join(writable)}")
    if path.exists() and path.is_dir() != target.folder:
        raise InputError(
            f"{path} is a {'folder' if path.is_dir() else 'file'}",
            f"a new {'folder' if target.folder else 'file'}, as {name} poses are one",
        )
    refuse_existing(path, overwrite, "a new path")
    target.write(path, trajectory)


#: What readers of poses expect.
EXPECTED = "a text file of poses"
#: A number with a decimal comma, and the beginning of any number.
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)
_LIKE_NUMBER = re.compile(r"[-+.]*\d|[-+]?(nan|inf)\b", re.IGNORECASE)
#: Bytes of a file read to recognise it.
_HEAD_BYTES = 65_536


def read_numbers(
    path: Path, count: int, expected: str, do: str, *, comments: bool = False
) -> list[tuple[int, list[float]]]:
    """Read rows of so many finite numbers, separated by commas, semicolons or blanks, each with its line number.

    ``expected`` and ``do`` are for the error about an invalid line. Where there may be ``comments``, lines that begin
    with ``#`` or ``%`` are, and lines without numbers before the first row, which name the columns.
    """
    rows: list[tuple[int, list[float]]] = []
    for number, line in text_lines(path, EXPECTED):
        words = _words(line)
        if not words or (comments and (_is_comment(words) or (not rows and _are_names(words)))):
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
    """Count of numbers in the first line of a text file behind comments and names; None if it holds anything else."""
    return _first_row(path)[1]


def _first_row(path: Path) -> tuple[str, int | None]:
    """The first line of a text file behind comments and names, and its count of numbers, None if others are there."""
    for line in head_text(path).splitlines():
        words = _words(line)
        if not words or _is_comment(words) or _are_names(words):
            continue
        try:
            return line, len([float(word) for word in words])
        except ValueError:
            return line, None
    return "", None


def head_text(path: Path) -> str:
    """The first characters of a text file, in any encoding that is read."""
    start = head(path)
    return start.decode(encoding_of(start), errors="replace")


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


def _words(line: str) -> list[str]:
    words = line.replace(";", " ").split()
    if len(words) > 1 and any(_DECIMAL_COMMA.fullmatch(word) for word in words):
        return words
    return [word for word in re.split(r"[,;\s]+", line) if word]


def _is_comment(words: list[str]) -> bool:
    return words[0].startswith(("#", "%"))


def _are_names(words: list[str]) -> bool:
    """Return True if the words of a line are names of columns: none is a number or begins like one."""
    return not any(_LIKE_NUMBER.match(word) for word in words)
