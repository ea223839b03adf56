"""Pose file formats, registered in :data:`coliags_plugin.config.registry.pose_formats`: detection and writing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.config.registry import pose_formats
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.poses.text import count_first_numbers
from coliags_plugin.geometry.poses.trajectory import Trajectory


@dataclass(frozen=True)
class Format:
    """A pose file format.

    Attributes:
        name: Name on the command line.
        read: Reads a file or folder.
        write: Writes a file or folder, replacing an existing one; None if the format is read-only.
        recognise: Whether a path has this format, by content; None if another format recognises it.
        unit: Its unit of length, or ``"units"`` if the format defines none.
        keeps: Further stored data: ``names``, ``timestamps``, ``intrinsics``.
        folder: Whether the format is a folder of files.
    """

    name: str
    read: Callable[[Path], Trajectory]
    write: Callable[[Path, Trajectory], None] | None
    recognise: Callable[[Path], bool] | None
    unit: str = "units"
    keeps: frozenset[str] = frozenset()
    folder: bool = False


def format_named(name: str) -> Format:
    """The format with a given name."""
    known: Format = pose_formats.get(name)
    return known


def format_of(path: Path, name: str | None = None) -> Format:
    """The format of an existing file or folder, by its name or, where that is None, by the content.

    Raises:
        InputError: The path or format does not exist; a file is given for a folder format, or the other way round; or
            the content has none of the formats.
    """
    if not path.exists():
        raise InputError(f"no file or folder {path}", "poses")
    if name is not None:
        known = format_named(name)
        if path.is_dir() and not known.folder:
            raise InputError(f"{path} is a folder", f"the {known.name} file itself")
        return known
    for known in map(format_named, pose_formats):
        if known.recognise is not None and known.recognise(path):
            return known
    if path.is_dir():
        held = sorted(entry.name for entry in path.iterdir())
        shown = f"{', '.join(held[:3])}{f' and {len(held) - 3} more' if len(held) > 3 else ''}" if held else "nothing"
        raise InputError(f"{path} holds {shown}", "the folder of a COLMAP model, or a pose file inside a folder")
    count = count_first_numbers(path)
    raise InputError(
        f"{path} has no known pose format: its first line holds "
        + (f"{count} numbers" if count is not None else "no row of numbers"),
        "16 numbers per line (c3vd), 8 (tum), a params.npz (endogslam) or a transforms.json (nerfstudio)",
    )


def write_trajectory(path: Path, trajectory: Trajectory, name: str, overwrite: bool = False) -> None:
    """Write a trajectory atomically; the parent folder is made.

    Raises:
        InputError: The format is unknown or read-only; the path exists and ``overwrite`` is off; or as the format's
            writer.
    """
    known = format_named(name)
    if known.write is None:
        writable = [other for other in pose_formats if format_named(other).write is not None]
        raise InputError(f"format '{name}' is read-only", f"one of {', '.join(writable)}")
    if path.exists() and path.is_dir() != known.folder:
        raise InputError(
            f"{path} is a {'folder' if path.is_dir() else 'file'}",
            f"a new {'folder' if known.folder else 'file'}, as {name} poses are one",
        )
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path} already exists", "a new path", "Choose another, or pass --overwrite")
    known.write(path, trajectory)
