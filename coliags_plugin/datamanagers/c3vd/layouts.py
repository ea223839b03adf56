"""Recognises C3VD's two layouts from a folder's files (docs/layouts/c3vd.md 1, 3)."""

from __future__ import annotations

import re
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.c3vd.sequences import SequenceFiles
from coliags_plugin.datamanagers.reading.frame_files import (
    DEPTH_SUFFIXES,
    IMAGE_SUFFIXES,
    TIFF_SUFFIXES,
    inventory,
    numbered,
    paired,
)

KINDS = (
    "the raw release (NNNN_color.png, NNNN_depth.tiff and pose.txt in one folder) "
    "or the undistorted layout (images/, depths/, camera_pose.txt and camera.json)"
)


def recognise(folder: Path) -> str | None:
    """The files that identify one of the two layouts; None if the folder has neither."""
    if (folder / "camera_pose.txt").is_file() and (folder / "images").is_dir():
        return "camera_pose.txt beside images/"
    if (folder / "pose.txt").is_file() and next(folder.glob("*_color.png"), None) is not None:
        return "pose.txt beside NNNN_color.png"
    return None


def find_layout(folder: Path) -> SequenceFiles:
    """Find the files of a sequence; ``kind`` is ``raw`` (distorted images) or ``undistorted`` (pinhole images).

    Raises:
        InputError: The folder is missing, has neither layout or parts of both, or its files do not pair up.
    """
    if not folder.is_dir():
        raise InputError(f"no folder {folder}", f"a C3VD sequence: {KINDS}", "Check the path")
    raw = [path for path in folder.iterdir() if re.fullmatch(r"\d+_color\.png", path.name)]
    if raw and (folder / "images").is_dir():
        raise InputError(
            f"{folder} holds both {raw[0].name} and images/",
            "one sequence in one layout",
            "Move one of the two to its own folder",
        )
    if raw:
        images = numbered(folder, "color", frozenset({".png"}))
        depths = numbered(folder, "depth", TIFF_SUFFIXES)
        return _complete("raw", folder, images, depths, folder / "pose.txt", None)
    if (folder / "images").is_dir():
        images = numbered(folder / "images", "color", IMAGE_SUFFIXES)
        if not images:
            raise InputError(f"{folder / 'images'} holds {inventory(folder / 'images')}", "<number>_color.png files")
        depths = numbered(folder / "depths", "depth", DEPTH_SUFFIXES) if (folder / "depths").is_dir() else {}
        return _complete("undistorted", folder, images, depths, folder / "camera_pose.txt", folder / "camera.json")
    raise InputError(
        f"{folder} holds {inventory(folder)}",
        KINDS,
        "Name the sequence's own folder, for instance cecum_t1_a",
    )


def _complete(
    kind: str,
    folder: Path,
    images: dict[int, Path],
    depths: dict[int, Path],
    poses: Path,
    camera: Path | None,
) -> SequenceFiles:
    for path in filter(None, (poses, camera)):
        if not path.is_file():
            raise InputError(f"{folder} has images but no {path.name}", f"{KINDS}", f"Add {path.name}")
    return SequenceFiles(kind, folder, *paired(folder, images, depths), poses, camera)
