"""Description of a pose file format; the registry is :data:`coliags_plugin.config.registry.pose_formats`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
