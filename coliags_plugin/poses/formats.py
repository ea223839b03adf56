"""Which format a pose file is in, and writing one."""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.config.registry import pose_formats
from coliags_plugin.core.errors import InputError
from coliags_plugin.poses.format import Format
from coliags_plugin.poses.text import count_first_numbers
from coliags_plugin.poses.trajectory import Trajectory


def format_named(name: str) -> Format:
    """The format of a name.

    Raises:
        InputError: There is none.
    """
    known: Format = pose_formats.get(name)
    return known


def format_of(path: Path, name: str | None = None) -> Format:
    """The format of a file or folder.

    Args:
        path: A file or folder that is there.
        name: The format, where it is known; otherwise content tells.

    Raises:
        InputError: There is no such path or format; a file is given for a format that is a folder, or the other way
            round; or the content is none of the formats.
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
        held = sorted(found.name for found in path.iterdir())
        shown = f"{', '.join(held[:3])}{f' and {len(held) - 3} more' if len(held) > 3 else ''}" if held else "nothing"
        raise InputError(f"{path} holds {shown}", "the folder of a COLMAP model, or a pose file inside a folder")
    count = count_first_numbers(path)
    raise InputError(
        f"{path} is no pose file known here: its first line holds "
        + (f"{count} numbers" if count is not None else "no row of numbers"),
        "16 numbers a line (c3vd), 8 (tum), a params.npz (endogslam) or a transforms.json (nerfstudio)",
    )


def write_trajectory(path: Path, trajectory: Trajectory, name: str, overwrite: bool = False) -> None:
    """Write a trajectory, whole or not at all.

    Args:
        path: Where to; its folder is made.
        trajectory: What to write.
        name: The format.
        overwrite: Replace what is there; of folders, nothing but a COLMAP model.

    Raises:
        InputError: There is no such format or it is only read; the path exists and ``overwrite`` is off; or as the
            format's writer.
    """
    known = format_named(name)
    if known.write is None:
        writable = [other for other in pose_formats if format_named(other).write is not None]
        raise InputError(f"'{name}' is only read", f"one of {', '.join(writable)}")
    if path.exists() and path.is_dir() != known.folder:
        raise InputError(
            f"{path} is a {'folder' if path.is_dir() else 'file'}",
            f"a new {'folder' if known.folder else 'file'}, as {name} poses are one",
        )
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path} already exists", "a new place", "Choose another, or pass --overwrite")
    known.write(path, trajectory)
