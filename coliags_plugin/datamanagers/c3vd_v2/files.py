"""Finding the files of a C3VDv2 sequence (docs/layouts/c3vd-v2.md 1)."""

from __future__ import annotations

import re
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.c3vd.sequences import SequenceFiles
from coliags_plugin.datamanagers.reading.frame_files import TIFF_SUFFIXES, inventory, numbered, paired
from coliags_plugin.geometry.poses.c3vd import recognise as has_matrices

LAYOUT = "rgb/NNNN.png and pose.txt, for registered videos also depth/NNNN_depth.tiff"
#: Announced for the release; its location and format are not documented.
INTRINSICS = "camera_intrinsics.txt"


def recognise(folder: Path) -> str | None:
    """The files that identify a C3VDv2 sequence; None if the folder is none."""
    numbers = any(re.fullmatch(r"\d+", path.stem) for path in folder.glob("rgb/*.png"))
    if numbers and (folder / "pose.txt").is_file() and has_matrices(folder / "pose.txt"):
        return "pose.txt (16 numbers a line) beside rgb/NNNN.png"
    return None


def find_sequence(folder: Path) -> SequenceFiles:
    """Find the files of a sequence; ``camera`` is the intrinsics file in it or up to two folders up, or None.

    Raises:
        InputError: The folder is missing or has another layout, or its files do not pair up.
    """
    if not folder.is_dir():
        raise InputError(f"no folder {folder}", f"a C3VDv2 sequence: {LAYOUT}", "Check the path")
    images = numbered(folder / "rgb", "", frozenset({".png"})) if (folder / "rgb").is_dir() else {}
    if not images:
        searched = folder / "rgb" if (folder / "rgb").is_dir() else folder
        raise InputError(
            f"{searched} holds {inventory(searched)}",
            LAYOUT,
            "Name the sequence's own folder, for instance c1_cecum_t1_v1",
        )
    poses = folder / "pose.txt"
    if not poses.is_file():
        raise InputError(f"{folder} has images but no pose.txt", LAYOUT, "Add pose.txt")
    depths = numbered(folder / "depth", "depth", TIFF_SUFFIXES) if (folder / "depth").is_dir() else {}
    here = folder.resolve()
    camera = next((path / INTRINSICS for path in (here, *here.parents[:2]) if (path / INTRINSICS).is_file()), None)
    return SequenceFiles("c3vd-v2", folder, *paired(folder, images, depths), poses, camera)
