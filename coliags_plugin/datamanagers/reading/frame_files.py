"""Finding the numbered files of a video."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from coliags_plugin.core.errors import InputError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
TIFF_SUFFIXES = frozenset({".tiff", ".tif"})
DEPTH_SUFFIXES = TIFF_SUFFIXES | {".png"}


def numbered(folder: Path, what: str, suffixes: frozenset[str]) -> dict[int, Path]:
    """Files ``<number>_<what>`` by number, padded or not; ``<number>`` alone if ``what`` is empty.

    Raises:
        InputError: Two files have the same number.
    """
    found: dict[int, Path] = {}
    pattern = rf"(\d+)_{what}" if what else r"(\d+)"
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(pattern, path.stem)
        if match is None or path.suffix.lower() not in suffixes:
            continue
        index = int(match.group(1))
        if index in found:
            raise InputError(f"{found[index]} and {path.name} have the same number", "one file per frame", "Remove one")
        found[index] = path
    return found


def paired(
    folder: Path, images: Mapping[int, Path], depths: Mapping[int, Path]
) -> tuple[tuple[Path, ...], tuple[Path, ...] | None]:
    """Image files and, if any, depth files in frame order.

    Args:
        folder: Folder of the sequence, for errors.
        images: Images by number; at least one.
        depths: Depth files by number; none, or one for every image.

    Raises:
        InputError: Numbers do not run from 0 without gaps, or images and depth files do not pair up.
    """
    count = len(images)
    gap = next((index for index in range(count) if index not in images), None)
    if gap is not None:
        first, last = min(images), max(images)
        raise InputError(
            f"{images[first].parent} has {count} images, numbers {first} to {last}, but none is {gap}",
            "numbers from 0 without gaps, as line n of the pose file belongs to image n",
            "Restore the missing images, or renumber them and drop their poses",
        )
    if depths and sorted(depths) != sorted(images):
        lone = min(set(depths) ^ set(images))
        raise InputError(
            f"{folder} has {count} images and {len(depths)} depth files; frame {lone} has only one of the two",
            "a depth file for every image, or none at all",
            "Restore the missing files: incomplete archives are common",
        )
    frames = range(count)
    return tuple(images[index] for index in frames), tuple(depths[index] for index in frames) if depths else None


def numbered_masks(folder: Path, what: str, count: int) -> dict[int, Path]:
    """Files ``<number>_<what>.png`` by frame index; empty if the folder is missing.

    Raises:
        InputError: A file has no frame.
    """
    found = numbered(folder, what, frozenset({".png"})) if folder.is_dir() else {}
    for index, path in found.items():
        if index >= count:
            raise InputError(
                f"{path}, but there are {count} frames",
                f"numbers below {count}",
                "Restore the missing frames, or remove the file",
            )
    return found


def inventory(folder: Path) -> str:
    """The first few names in a folder, for error messages."""
    names = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    if not names:
        return "nothing"
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
