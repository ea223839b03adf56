"""Description of a posed video on disk."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.reading.files import numbered
from coliags_plugin.datamanagers.shots import Shot
from coliags_plugin.geometry.poses.c3vd import C3vdPoses, read_poses

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Recording:
    """A posed video on disk."""

    kind: str  # dataset and layout, for the log
    shots: Sequence[Shot]  # frames in video order
    facts: Mapping[str, Any]  # provenance: layout, lens, sizes, pose convention and so on
    fingerprint: str  # hash of the files; see :func:`fingerprint`
    test_sets: Mapping[str, Sequence[Shot]] = field(default_factory=dict)  # the dataset's separate ones, by name
    own_split: Mapping[str, Sequence[int]] | None = None  # the dataset's: "train" and "test" indices into ``shots``
    own_points: Callable[[], PointCloud] | None = None  # reads the dataset's initial points; None where there are none
    points_source: Path | None = None  # the file or folder of these points
    #: Seen masks by frame index: of ``shots`` under "video", and of test sets by their names.
    seen: Mapping[str, Mapping[int, Path]] = field(default_factory=dict)
    #: Indices into ``shots`` of the images that "depth", or "points" with their depth, were made from, where known.
    made_from: Mapping[str, Collection[int]] = field(default_factory=dict)


def portable_name(path: Path, folder: Path) -> str:
    """Path relative to a scene's folder, or the file name alone outside of it: no path of this machine."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def fingerprint(folder: Path, large: Iterable[Path | None], small: Iterable[Path | None]) -> str:
    """SHA-256 of the names and sizes of large files and the contents of small ones."""
    digest = hashlib.sha256()
    try:
        for path in filter(None, large):
            named = f"{portable_name(path, folder)} {path.stat().st_size}\n"
            digest.update(named.encode("utf-8", "surrogateescape"))
        for path in filter(None, small):
            with path.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a readable file", "Restore it") from error
    return digest.hexdigest()


def poses_of_images(file: Path, images: int) -> C3vdPoses:
    """The poses of a file of C3VD's form, of which every image must have one."""
    poses = read_poses(file)
    if len(poses.camera_to_world) != images:
        raise InputError(
            f"{file} has {len(poses.camera_to_world)} poses for {images} images",
            "a pose for every image, in order",
            "Restore the missing ones, or remove the surplus at the end",
        )
    return poses


#: Folder and test set of the rotation views of a sequence.
ROTATION = "rotation"


def find_seen_masks(path: Path, count: int, complete: bool = True) -> dict[int, Path]:
    """Seen masks ``seen/NNNN_seen.png`` in ``path``, by frame index.

    ``complete`` tells whether the frames are all images of the dataset. Masks are numbered by image, so that they do
    not match frames where images are left out.
    """
    folder = path / "seen"
    if not complete:
        if folder.is_dir():
            log.warning(
                "%s: seen masks are for all images, but some are left out, so metrics on seen pixels are unavailable",
                folder,
            )
        return {}
    masks = numbered(folder, "seen", frozenset({".png"}))
    for index, mask in masks.items():
        if index >= count:
            do = "Restore the missing frames, or remove the file"
            raise InputError(f"{mask}, but there are {count} frames", f"numbers below {count}", do)
    return masks
