"""Frames on disk: their files, the rectification of their images, and pixels that are read when they are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor
from typing_extensions import override

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import has_alpha, read_alpha, read_rgb
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import PIXEL_MAPS, PixelSource, SparseDepth
from coliags_plugin.datamanagers.file_formats import (
    DepthFormat,
    all_of,
    read_gray,
    read_mask,
    resize_nearest,
    resize_rgb,
    size_of,
)
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.geometry.lenses.undistortion import Undistortion

#: How far a raw frame's aspect ratio may be from the lens's: rounding to whole pixels, but no cropping.
ASPECT_TOLERANCE = 0.02

#: The paper's working size, a quarter of C3VD's raw frame.
PAPER_SIZE = (338, 270)

#: Undistortions kept at a time, some 10 MB each: as many as images are read in parallel. COLMAP models often have one
#: camera per image.
_KEPT = 8


def fitted(width: int, height: int, within: tuple[int, int] | None) -> tuple[int, int]:
    """The largest size within another, pixels, that keeps the aspect ratio and enlarges nothing; None: as it is."""
    scale = 1.0 if within is None else min(1.0, within[0] / width, within[1] / height)
    if scale == 1.0:
        return width, height
    # Halves are rounded up: the paper's 338 is a quarter of 1350.
    fitted = int(width * scale + 0.5), int(height * scale + 0.5)
    return max(1, fitted[0]), max(1, fitted[1])


@dataclass(frozen=True, eq=False)
class Rectification:
    """Rectification of the stored images of one camera to its working images."""

    lens: Lens  # of the stored images
    pinhole: Intrinsics  # of the working images
    described_by: Path  # the file with the size of the stored images, for errors
    stored_content: Bool[np.ndarray, "H W"] | None = None  # stored pixels with image content; None where all have

    @property
    def undistortion(self) -> Undistortion | None:
        """Undistortion of the stored images; None if they are a pinhole camera's."""
        return None if isinstance(self.lens, PinholeLens) else _undistortion(self)

    def camera(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Camera:
        """The working camera at a pose."""
        return Camera.of(self.pinhole, torch.from_numpy(camera_to_world.astype(np.float32)))

    def image(self, rgb: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """A colour image at the working size."""
        if (undistortion := self.undistortion) is None:
            return resize_rgb(rgb, self.pinhole.width, self.pinhole.height)
        return undistortion.image(rgb)

    def nearest(self, values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "h w"]:
        """Values at the working size by nearest neighbour; 0 where there is no source."""
        if (undistortion := self.undistortion) is None:
            return resize_nearest(values, self.pinhole.width, self.pinhole.height)
        return undistortion.nearest(values, 0)

    def resampled(self, name: str, path: Path, values: Shaped[np.ndarray, "H W ..."]) -> Shaped[np.ndarray, "h w ..."]:
        """The per-pixel map of a name, read from a file, at the working size; checks its size as :meth:`checked`."""
        stored = self.checked(path, values)
        return self.image(stored) if PIXEL_MAPS[name].is_smooth else self.nearest(stored)

    @property
    def valid(self) -> Bool[np.ndarray, "h w"] | None:
        """Working pixels with image content; None where all have."""
        undistortion = self.undistortion
        return None if undistortion is None or undistortion.valid.all() else undistortion.valid

    def facts(self) -> dict[str, Any]:
        """For provenance: sizes, and intrinsics at the working size."""
        k = self.pinhole
        return {
            "stored_size": [self.lens.width, self.lens.height],
            "size": [self.pinhole.width, self.pinhole.height],
            "intrinsics": {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "pixel_centers": "integers + 0.5"},
        }

    def checked(self, path: Path, image: np.ndarray) -> np.ndarray:
        """A stored image, unchanged, after a check of its size."""
        height, width = image.shape[:2]
        if (width, height) != (self.lens.width, self.lens.height):
            is_turned = (height, width) == (self.lens.width, self.lens.height)
            raise InputError(
                f"{path} is {width} x {height}, but {self.described_by} says {self.lens.width} x {self.lens.height}",
                "images of one size, that of their intrinsics" + "; EXIF's orientation is not applied" * is_turned,
                "Write that image again, or correct the size in that file",
            )
        return image


@lru_cache(maxsize=_KEPT)
def _undistortion(rectification: Rectification) -> Undistortion:
    return Undistortion(rectification.lens, rectification.pinhole, rectification.stored_content)


def whole_frame(lens: Lens, image: Path, described_by: str, do: str) -> Lens:
    """The lens at the size of an image of the whole calibrated frame; InputError, with what to ``do``, for crops."""
    width, height = size_of(image)
    if abs((width / height) / (lens.width / lens.height) - 1.0) > ASPECT_TOLERANCE:
        raise InputError(
            f"{image} is {width} x {height}, but {described_by} is for {lens.width} x {lens.height}",
            "images of that size, or scaled from it",
            do,
        )
    return lens.resized(width, height)


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
    sparse_depth: SparseDepth | None = None  # at single points of the working image
    confidence: Path | None = None  # 8-bit grey, of the depth file's size: how far depth can be trusted, 255 = 1

    @cached_property
    def has_alpha(self) -> bool:
        """True if the image has an alpha channel, by its header."""
        return has_alpha(self.image)

    def shown(self) -> Bool[np.ndarray, "H W"] | None:
        """Pixels of the stored image that its alpha channel does not hide; None where it hides none."""
        shown = read_alpha(self.image) if self.has_alpha else None
        return None if shown is None else self.rectification.checked(self.image, shown)


def make_shots(
    images: Sequence[Path],
    rectification: Rectification,
    camera_to_world: Float[np.ndarray, "N 4 4"],
    depths: Sequence[Path | None] | None,
    depth_format: DepthFormat | None,
    prefix: str = "",
    masks: Sequence[Path | None] | None = None,
    confidences: Sequence[Path | None] | None = None,
) -> list[Shot]:
    """Frames of one camera, named by their image files behind ``prefix``."""
    none = (None,) * len(images)
    files = zip(images, camera_to_world, depths or none, masks or none, confidences or none, strict=True)
    return [
        Shot(prefix + image.stem, image, rectification, pose, depth, depth_format, mask, confidence=confidence)
        for image, pose, depth, mask, confidence in files
    ]


@dataclass(frozen=True, eq=False)
class StoredPixels(PixelSource):
    """The per-pixel maps of a shot, read when they are used and cached in the stored data types.

    That takes 5 bytes per pixel with 16-bit depth. Thread-safe. Reading raises InputError if a file is damaged or has
    the wrong format or size.

    Attributes:
        keep: Whether maps are cached; otherwise, every access reads its file.
        seen_mask: Mask that is black where no training frame sees the surface; None where there is none.
        scale: Factor from lengths of the shot to those of the maps.
    """

    shot: Shot
    keep: bool = True
    seen_mask: Path | None = None
    scale: float = 1.0
    _cache: dict[str, np.ndarray | None] = field(default_factory=dict, repr=False)

    @property
    def camera_to_world(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the shot in the world of the maps, OpenCV axes."""
        pose = self.shot.camera_to_world.copy()
        pose[:3, 3] *= self.scale
        return pose

    @override
    def scaled(self, factor: float) -> StoredPixels:
        return replace(self, scale=factor * self.scale)

    @override
    def read(self, name: str) -> Tensor | None:
        values, schema, form = self.stored(name), PIXEL_MAPS[name], self.shot.depth_format
        if values is not None and schema.is_length and form is not None:
            depth, bound = form.decode(values)
            lengths = depth if name == "depth" else bound
            values = None if lengths is None else lengths * np.float32(self.scale)
            if values is not None and ((values <= 0.0) | (values > schema.high)).any():  # not of NaN
                raise InputError(
                    f"{self.shot.depth}: depth reaches from {np.nanmin(values):g} to {np.nanmax(values):g} scene units",
                    f"above 0, and at most {schema.high:g}",
                    "Correct the scale of depth",
                )
        if values is not None and name == "depth_confidence":
            values = values.astype(np.float32) / np.float32(255.0)
        return None if values is None else torch.from_numpy(values)

    @override
    def read_all(self) -> dict[str, Tensor]:
        return super().read_all() if self.keep else replace(self, keep=True, _cache={}).read_all()

    def preload(self) -> None:
        """Fill the cache."""
        for name in PIXEL_MAPS:
            self.stored(name)

    def stored(self, name: str) -> Shaped[np.ndarray, "H W ..."] | None:
        """The map that a file holds, at the working size and in the stored data type."""
        name = "depth" if name == "depth_at_least" else name
        if not self.keep:
            return self._from_file(name)
        # If two threads read at the same time, the second overwrites the cache with equal data.
        if name not in self._cache:
            self._cache[name] = self._from_file(name)
        return self._cache[name]

    def _from_file(self, name: str) -> np.ndarray | None:
        shot, resampled = self.shot, self.shot.rectification.resampled
        if name == "image":
            return resampled(name, shot.image, read_rgb(shot.image))
        if name == "mask":
            mask = None if shot.mask is None else resampled(name, shot.mask, read_mask(shot.mask))
            shown = shot.shown()
            if shown is not None:  # working pixels that mix in the colour of a hidden one are hidden, too
                shown = shot.rectification.image(shown.astype(np.uint8) * 255) == 255
            return all_of(shot.rectification.valid, mask, shown)
        if name == "depth" and shot.depth is not None and shot.depth_format is not None:
            depth, mask = resampled(name, shot.depth, shot.depth_format.read(shot.depth)), self.stored("mask")
            return depth if mask is None else np.where(mask, depth, np.zeros((), depth.dtype))
        if name == "seen" and self.seen_mask is not None:
            return resampled(name, self.seen_mask, read_mask(self.seen_mask))
        if name == "depth_confidence" and shot.confidence is not None:
            expected = "a one-channel 8-bit image of the confidence in depth, 255 = 1"
            return resampled(name, shot.confidence, read_gray(shot.confidence, 8, expected))
        return None
