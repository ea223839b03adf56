"""Description of a posed video on disk: image files, poses, cameras, depth files and masks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
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
    """Files, pose and camera of one frame on disk.

    Attributes:
        name: Unique within the recording.
        image: The image file.
        rectification: Mapping from the stored to the working image; shared by images of the same camera.
        camera_to_world: Rigid, OpenCV axes, scene units. [4, 4]
        depth: Depth file.
        depth_format: Format of the depth file.
        mask: Mask file of the image's size; black pixels are ignored.
        seen: Mask file of the image's size; not black where training frames see the same surface.
        sparse_depth: Depth at single points of the working image.
        confidence: 8-bit grey image of the depth file's size: how far estimated depth can be trusted, 255 = 1.
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
    confidence: Path | None = None


def make_shots(
    images: Sequence[Path],
    rectification: Rectification,
    camera_to_world: Float[np.ndarray, "N 4 4"],
    depths: Sequence[Path | None] | None,
    depth_format: DepthFormat | None,
    seen: Mapping[int, Path],
    prefix: str = "",
) -> list[Shot]:
    """Frames of one camera, named by their image files behind ``prefix``; ``seen`` are seen masks by frame index."""
    return [
        Shot(prefix + image.stem, image, rectification, pose, depth, depth_format, seen=seen.get(index))
        for index, (image, pose, depth) in enumerate(
            zip(images, camera_to_world, depths or (None,) * len(images), strict=True)
        )
    ]


@dataclass(frozen=True)
class Recording:
    """A posed video on disk.

    Attributes:
        kind: Dataset and layout, for the log.
        shots: Frames in video order.
        facts: Provenance: layout, lens, sizes, pose convention and so on.
        fingerprint: Hash of the files; see :func:`fingerprint`.
        test_sets: The dataset's separate test sets, by name.
        own_split: The dataset's split as indices into ``shots``, ``{"train": ..., "test": ...}``.
        own_points: Reads the dataset's initial points; None where there are none.
        points_source: The file or folder of these points.
    """

    kind: str
    shots: Sequence[Shot]
    facts: Mapping[str, Any]
    fingerprint: str
    test_sets: Mapping[str, Sequence[Shot]] = field(default_factory=dict)
    own_split: Mapping[str, Sequence[int]] | None = None
    own_points: Callable[[], PointCloud] | None = None
    points_source: Path | None = None


#: Bytes read at once.
_BLOCK = 1 << 20


def fingerprint(folder: Path, large: Iterable[Path | None], small: Iterable[Path | None]) -> str:
    """SHA-256 of the names and sizes of large files and the contents of small ones."""
    digest = hashlib.sha256()
    for path in filter(None, large):
        name = path.relative_to(folder) if path.is_relative_to(folder) else path.name
        with _readable(path):
            size = path.stat().st_size
        digest.update(f"{Path(name).as_posix()} {size}\n".encode("utf-8", "surrogateescape"))
    for path in filter(None, small):
        with _readable(path), path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a readable file", "Restore it") from error


def check_pose_count(file: Path, poses: int, images: int) -> None:
    """Raise InputError if the numbers of poses and images differ."""
    if poses != images:
        raise InputError(
            f"{file} has {poses} poses for {images} images",
            "a pose for every image, in order",
            "Restore the missing ones, or remove the surplus at the end",
        )
