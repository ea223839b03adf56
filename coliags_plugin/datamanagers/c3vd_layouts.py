"""Which of C3VD's two layouts a folder has, told by the files in it and never by its name (docs/data.md 1, 3)."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from coliags_plugin.errors import InputError
from coliags_plugin.lenses import Pinhole

KINDS = (
    "the raw release (NNNN_color.png, NNNN_depth.tiff and pose.txt in one folder) "
    "or the undistorted layout (images/, depths/, camera_pose.txt and camera.json)"
)
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
DEPTH_SUFFIXES = frozenset({".png", ".tiff", ".tif"})


@dataclass(frozen=True)
class Layout:
    """The files of one sequence.

    Attributes:
        kind: ``raw``: distorted pictures; ``undistorted``: pinhole pictures and their intrinsics.
        folder: Where the sequence is.
        images: Colour pictures, frame 0 first.
        depths: Depth pictures of the same frames; None where there is not one.
        poses: The pose file.
        camera: ``camera.json`` of the undistorted layout.
    """

    kind: Literal["raw", "undistorted"]
    folder: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: Path
    camera: Path | None = None


def recognise(folder: Path) -> str | None:
    """What in the folder says that it is one of the two layouts; None where nothing does."""
    if (folder / "camera_pose.txt").is_file() and (folder / "images").is_dir():
        return "camera_pose.txt beside images/"
    if (folder / "pose.txt").is_file() and next(folder.glob("*_color.png"), None) is not None:
        return "pose.txt beside NNNN_color.png"
    return None


def find_layout(folder: Path) -> Layout:
    """Look at a folder.

    Raises:
        InputError: It is missing, holds neither layout or parts of both, or its frames do not pair up.
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
        images = _by_index(folder, "color", frozenset({".png"}))
        depths = _by_index(folder, "depth", frozenset({".tiff", ".tif"}))
        return _paired("raw", folder, images, depths, folder / "pose.txt", None)
    if (folder / "images").is_dir():
        images = _by_index(folder / "images", "color", IMAGE_SUFFIXES)
        if not images:
            raise InputError(f"{folder / 'images'} holds {_inventory(folder / 'images')}", "<number>_color.png files")
        depths = _by_index(folder / "depths", "depth", DEPTH_SUFFIXES) if (folder / "depths").is_dir() else {}
        return _paired("undistorted", folder, images, depths, folder / "camera_pose.txt", folder / "camera.json")
    raise InputError(
        f"{folder} holds {_inventory(folder)}",
        KINDS,
        "Name the sequence's own folder, for instance cecum_t1_a",
    )


def find_optional(folder: Path, what: str, count: int) -> dict[int, Path]:
    """``<number>_<what>.png`` files by frame, none where the folder is absent.

    Raises:
        InputError: One belongs to no frame.
    """
    found = _by_index(folder, what, frozenset({".png"})) if folder.is_dir() else {}
    for index, path in found.items():
        if index >= count:
            raise InputError(f"{path}, but there are {count} frames", f"numbers below {count}", "Remove the file")
    return found


def read_intrinsics(path: Path) -> tuple[Pinhole, int, int]:
    """Intrinsics (pixel centres at integers), width and height from a ``camera.json``.

    Raises:
        InputError: It is not JSON, or keys are missing, or their values are not sizes and focal lengths.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}", "a JSON object") from error
    keys = ("fx", "fy", "cx", "cy", "w", "h")
    if not isinstance(data, dict) or any(key not in data for key in keys):
        missing = [key for key in keys if not isinstance(data, dict) or key not in data]
        raise InputError(
            f"{path} has no {', '.join(missing)}",
            "fx, fy, cx, cy in pixels (centres at integers) and the picture's w, h",
            "Add them",
        )
    values = [data[key] for key in keys]
    numbers = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v)]
    if len(numbers) < len(keys) or min(numbers[0], numbers[1], numbers[4], numbers[5]) <= 0:
        raise InputError(f"{path}: {dict(zip(keys, values, strict=True))}", "numbers, focal lengths and sizes above 0")
    fx, fy, cx, cy, width, height = numbers
    if width != int(width) or height != int(height):
        raise InputError(f"{path}: w = {width}, h = {height}", "whole pixels")
    return Pinhole(float(fx), float(fy), float(cx), float(cy)), int(width), int(height)


def _paired(
    kind: Literal["raw", "undistorted"],
    folder: Path,
    images: dict[int, Path],
    depths: dict[int, Path],
    poses: Path,
    camera: Path | None,
) -> Layout:
    for path in filter(None, (poses, camera)):
        if not path.is_file():
            raise InputError(f"{folder} has pictures but no {path.name}", f"{KINDS}", f"Add {path.name}")
    count = len(images)
    gap = next((index for index in range(count) if index not in images), None)
    if gap is not None:
        first, last = min(images), max(images)
        raise InputError(
            f"{images[first].parent} has {count} pictures, numbers {first} to {last}, but none is {gap}",
            "numbers from 0 without gaps, for line n of the pose file belongs to picture n",
            "Restore the missing pictures, or renumber them and drop their poses",
        )
    if depths and sorted(depths) != sorted(images):
        lone = min(set(depths) ^ set(images))
        raise InputError(
            f"{folder} has {count} pictures and {len(depths)} depth files; frame {lone} has only one of the two",
            "a depth file for every picture, or none at all",
            "Restore the missing files: archives cut short are common",
        )
    return Layout(
        kind,
        folder,
        tuple(images[index] for index in range(count)),
        tuple(depths[index] for index in range(count)) if depths else None,
        poses,
        camera,
    )


def _by_index(folder: Path, what: str, suffixes: frozenset[str]) -> dict[int, Path]:
    """``<number>_<what>.<suffix>`` files by their number: older releases do not pad it."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(rf"(\d+)_{what}", path.stem)
        if match is None or path.suffix.lower() not in suffixes:
            continue
        index = int(match.group(1))
        if index in found:
            raise InputError(f"{found[index]} and {path.name} have the same number", "one file per frame", "Remove one")
        found[index] = path
    return found


def _inventory(folder: Path) -> str:
    names = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    if not names:
        return "nothing"
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
