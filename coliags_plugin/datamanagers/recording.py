"""Description of a posed video on disk, and its frames, which read their pixels lazily."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_alpha, read_rgb
from coliags_plugin.core.scenes import PIXEL_MAPS, PixelSource, PointCloud, SparseDepth
from coliags_plugin.datamanagers.reading.files import numbered
from coliags_plugin.datamanagers.reading.images import DepthFormat, all_of, read_gray, read_mask
from coliags_plugin.datamanagers.rectification import Rectification
from coliags_plugin.geometry.poses.c3vd import C3vdPoses, read_poses

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Shot:
    """Files, pose and camera of one frame on disk; mask files are of the image's size."""

    name: str  # unique within the recording
    image: Path
    rectification: Rectification  # from the stored to the working image; shared by images of the same camera
    camera_to_world: Float[np.ndarray, "4 4"]  # rigid, OpenCV axes, scene units
    depth: Path | None = None
    depth_format: DepthFormat | None = None
    mask: Path | None = None  # black pixels are ignored, besides those that the image's alpha channel hides
    seen: Path | None = None  # not black where training frames see the same surface; set where a scene is loaded
    sparse_depth: SparseDepth | None = None  # at single points of the working image
    confidence: Path | None = None  # 8-bit grey, of the depth file's size: how far depth can be trusted, 255 = 1

    def shown(self) -> Bool[np.ndarray, "H W"] | None:
        """Pixels of the stored image that its alpha channel does not hide; None where it hides none."""
        shown = read_alpha(self.image)
        return None if shown is None else self.rectification.checked(self.image, shown)


def make_shots(
    images: Sequence[Path],
    rectification: Rectification,
    camera_to_world: Float[np.ndarray, "N 4 4"],
    depths: Sequence[Path | None] | None,
    depth_format: DepthFormat | None,
    prefix: str = "",
) -> list[Shot]:
    """Frames of one camera, named by their image files behind ``prefix``."""
    return [
        Shot(prefix + image.stem, image, rectification, pose, depth, depth_format)
        for image, pose, depth in zip(images, camera_to_world, depths or (None,) * len(images), strict=True)
    ]


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


@dataclass(frozen=True, eq=False)
class StoredPixels(PixelSource):
    """The per-pixel maps of a shot, read when they are used and cached in the stored data types.

    That takes 5 bytes per pixel with 16-bit depth. Thread-safe. Reading raises InputError if a file is damaged or has
    the wrong format or size.

    Attributes:
        keep: Whether maps are cached; otherwise, every access reads its file.
        scale: Factor from lengths of the shot to those of the maps.
    """

    shot: Shot
    keep: bool = True
    scale: float = 1.0
    _cache: dict[str, np.ndarray | None] = field(default_factory=dict, repr=False)

    @property
    def camera_to_world(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the shot in the world of the maps, OpenCV axes."""
        pose = self.shot.camera_to_world.copy()
        pose[:3, 3] *= self.scale
        return pose

    def scaled(self, factor: float) -> StoredPixels:
        """See :class:`PixelSource`."""
        return replace(self, scale=factor * self.scale)

    def read(self, name: str) -> Tensor | None:
        """See :class:`PixelSource`; depth and its confidence are decoded each time."""
        stored = self._stored("depth" if name == "depth_at_least" else name)
        if stored is None:
            return None
        values, schema = self._decoded(name, stored), PIXEL_MAPS[name]
        if schema.is_length and values is not None and ((values <= 0.0) | (values > schema.high)).any():  # not of NaN
            raise InputError(
                f"{self.shot.depth}: depth reaches from {np.nanmin(values):g} to {np.nanmax(values):g} scene units",
                f"above 0, and at most {schema.high:g}",
                "Correct the scale of depth",
            )
        return None if values is None else torch.from_numpy(values)

    def read_all(self) -> dict[str, Tensor]:
        """See :class:`PixelSource`."""
        return super().read_all() if self.keep else replace(self, keep=True, _cache={}).read_all()

    def preload(self) -> None:
        """Fill the cache."""
        for name in _READERS:
            self._stored(name)

    def _decoded(self, name: str, stored: Shaped[np.ndarray, "H W ..."]) -> Shaped[np.ndarray, "H W ..."] | None:
        form = self.shot.depth_format
        if name == "depth" and form is not None:
            return form.z_depth(stored) * np.float32(self.scale)
        if name == "depth_at_least" and form is not None:
            bound = form.clipped_at(stored)
            return None if bound is None else bound * np.float32(self.scale)
        return stored.astype(np.float32) / np.float32(255.0) if name == "depth_confidence" else stored

    def _stored(self, name: str) -> Shaped[np.ndarray, "H W ..."] | None:
        """A map at the working size, in the stored data type."""
        if not self.keep:
            return _READERS[name](self)
        # If two threads read at the same time, the second overwrites the cache with equal data.
        if name not in self._cache:
            self._cache[name] = _READERS[name](self)
        return self._cache[name]


def _image(pixels: StoredPixels) -> UInt8[np.ndarray, "H W 3"]:
    shot = pixels.shot
    return shot.rectification.image(shot.rectification.checked(shot.image, read_rgb(shot.image)))


def _mask(pixels: StoredPixels) -> Bool[np.ndarray, "H W"] | None:
    shot, rectification = pixels.shot, pixels.shot.rectification
    mask = None if shot.mask is None else rectification.sampled(shot.mask, read_mask(shot.mask))
    shown = shot.shown()
    if shown is not None:  # working pixels that mix in the colour of a hidden one are hidden, too
        shown = rectification.image(shown.astype(np.uint8) * 255) == 255
    return all_of(rectification.valid, mask, shown)


def _depth(pixels: StoredPixels) -> Shaped[np.ndarray, "H W"] | None:
    shot = pixels.shot
    if shot.depth is None or shot.depth_format is None:
        return None
    depth, mask = shot.rectification.sampled(shot.depth, shot.depth_format.read(shot.depth)), pixels._stored("mask")
    return depth if mask is None else np.where(mask, depth, np.zeros((), depth.dtype))


def _seen(pixels: StoredPixels) -> Bool[np.ndarray, "H W"] | None:
    shot = pixels.shot
    return None if shot.seen is None else shot.rectification.sampled(shot.seen, read_mask(shot.seen))


def _confidence(pixels: StoredPixels) -> UInt8[np.ndarray, "H W"] | None:
    shot = pixels.shot
    if shot.confidence is None:
        return None
    stored = read_gray(shot.confidence, 8, "a one-channel 8-bit image of the confidence in depth, 255 = 1")
    return shot.rectification.sampled(shot.confidence, stored)


#: Readers of the maps that files hold, by name.
_READERS: Mapping[str, Callable[[StoredPixels], np.ndarray | None]] = {
    "image": _image,
    "depth": _depth,
    "mask": _mask,
    "seen": _seen,
    "depth_confidence": _confidence,
}
