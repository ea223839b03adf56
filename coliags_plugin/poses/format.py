"""What a kind of pose file has to say of itself; :data:`coliags_plugin.config.registry.pose_formats` names them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.poses.trajectory import Trajectory


@dataclass(frozen=True)
class Format:
    """One kind of pose file.

    Attributes:
        name: What it is called on the command line.
        read: Reads a file, or a folder, of the kind.
        write: Writes one in place of what is there, or None where the kind is only read.
        recognise: Whether a path is of this kind, by content; None where another format answers for it.
        unit: Its unit of length, or ``"units"`` where the format fixes none.
        keeps: What it keeps beside the poses: ``names``, ``timestamps``, ``intrinsics``.
        folder: Whether it is a folder of files.
    """

    name: str
    read: Callable[[Path], Trajectory]
    write: Callable[[Path, Trajectory], None] | None
    recognise: Callable[[Path], bool] | None
    unit: str = "units"
    keeps: frozenset[str] = frozenset()
    folder: bool = False
