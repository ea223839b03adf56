"""What a data set says before any pixel is read: which images, from where, with what beside them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import PointCloud, SparseDepth
from coliags_plugin.datamanagers.reading.depth_formats import DepthFormat
from coliags_plugin.datamanagers.rectification import Rectification


@dataclass(frozen=True)
class Shot:
    """One image as it lies on disk.

    Attributes:
        name: Unique within the recording.
        image: The image.
        view: How it becomes a working image; shared by images of the same camera.
        camera_to_world: Rigid, OpenCV axes, scene units. [4, 4]
        depth: Its depth file.
        depth_format: How to read that.
        mask: An image, not black where a pixel counts, as large as ``image``.
        seen: An image, not black where training frames see the same surface, as large as ``image``.
        sparse_depth: Depth at single points of the working image.
    """

    name: str
    image: Path
    rectification: Rectification
    camera_to_world: Float[np.ndarray, "4 4"]
    depth: Path | None = None
    depth_format: DepthFormat | None = None
    mask: Path | None = None
    seen: Path | None = None
    sparse_depth: SparseDepth | None = None


@dataclass(frozen=True)
class Recording:
    """A posed video as it lies on disk.

    Attributes:
        kind: Of data set and layout, for the log.
        shots: In video order.
        facts: For provenance: layout, lens, sizes, pose convention and whatever else was found out.
        fingerprint: Of the files; see :func:`fingerprint`.
        test_sets: Test sets that come with the data, apart from the video, by name.
        own_split: Indices in ``shots`` that the data themselves train and test on, ``{"train": ..., "test": ...}``.
        own_points: Reads the data's own initial points; None where there are none.
        points_source: The file or folder these come from.
    """

    kind: str
    shots: Sequence[Shot]
    facts: Mapping[str, Any]
    fingerprint: str
    test_sets: Mapping[str, Sequence[Shot]] = field(default_factory=dict)
    own_split: Mapping[str, Sequence[int]] | None = None
    own_points: Callable[[], PointCloud] | None = None
    points_source: Path | None = None


def fingerprint(folder: Path, large: Iterable[Path | None], small: Iterable[Path | None]) -> str:
    """SHA-256 over the names and sizes of large files and the contents of small ones."""
    digest = hashlib.sha256()
    for path in filter(None, large):
        name = path.relative_to(folder) if path.is_relative_to(folder) else path.name
        digest.update(f"{Path(name).as_posix()} {path.stat().st_size}\n".encode())
    for path in filter(None, small):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def check_pose_count(file: Path, poses: int, images: int) -> None:
    """Raise InputError where a pose file does not have a pose for every image."""
    if poses != images:
        raise InputError(
            f"{file} has {poses} poses for {images} images",
            "a pose for every image, in order",
            "Restore the missing ones, or remove the surplus at the end",
        )
