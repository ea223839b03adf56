"""Frames on disk: their files, the rectification of their images, and pixels that are read when they are used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

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
from coliags_plugin.datamanagers.reading.depth import DepthFormat
from coliags_plugin.datamanagers.reading.images import all_of, read_gray, read_mask, resize_nearest, resize_rgb, size_of
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.geometry.lenses.undistortion import Undistortion

_Key = TypeVar("_Key")

#: How far a raw frame's aspect ratio may be from the lens's: rounding to whole pixels, but no cropping.
ASPECT_TOLERANCE = 0.02

#: Distance of a principal point from the image centre, as a share of the image size, above which there is a warning.
FAR_FROM_MIDDLE = 0.2

#: The paper's working size, a quarter of C3VD's raw frame.
PAPER_SIZE = (338, 270)

#: Undistortions from many lenses kept at a time, some 10 MB each: as many as images are read in parallel.
_KEPT = 8


def fitted(width: int, height: int, within: tuple[int, int] | None) -> tuple[int, int]:
    """The largest size within another, pixels, that keeps the aspect ratio and enlarges nothing; None: as it is."""
    scale = 1.0 if within is None else min(1.0, within[0] / width, within[1] / height)
    if scale == 1.0:
        return width, height
    # Halves are rounded up: the paper's 338 is a quarter of 1350.
    fitted = int(width * scale + 0.5), int(height * scale + 0.5)
    return max(1, fitted[0]), max(1, fitted[1])


@dataclass(frozen=True)
class Rectification:
    """Rectification of the stored images of one camera to its working images."""

    lens: Lens  # of the stored images
    pinhole: Intrinsics  # of the working images
    described_by: Path  # the file with the size of the stored images, for errors
    undistortion: Callable[[], Undistortion] | None = None  # makes it, or returns the one that is kept; None: pinholes
    stored_content: Bool[np.ndarray, "H W"] | None = None  # stored pixels with image content; None where all have

    @property
    def width(self) -> int:
        """Working width, pixels."""
        return self.pinhole.width

    @property
    def height(self) -> int:
        """Working height, pixels."""
        return self.pinhole.height

    def camera(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Camera:
        """The working camera at a pose."""
        return Camera.of(self.pinhole, torch.from_numpy(camera_to_world.astype(np.float32)))

    def image(self, rgb: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """A colour image at the working size."""
        if self.undistortion is None:
            return resize_rgb(rgb, self.width, self.height)
        return self.undistortion().image(rgb)

    def nearest(self, values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "h w"]:
        """Values at the working size by nearest neighbour; 0 where there is no source."""
        if self.undistortion is None:
            return resize_nearest(values, self.width, self.height)
        return self.undistortion().nearest(values, 0)

    def resampled(self, name: str, path: Path, values: Shaped[np.ndarray, "H W ..."]) -> Shaped[np.ndarray, "h w ..."]:
        """The per-pixel map of a name, read from a file, at the working size; checks its size as :meth:`checked`."""
        stored = self.checked(path, values)
        return self.image(stored) if PIXEL_MAPS[name].is_smooth else self.nearest(stored)

    @property
    def valid(self) -> Bool[np.ndarray, "h w"] | None:
        """Working pixels with image content; None where all have."""
        valid = None if self.undistortion is None else self.undistortion().valid
        return None if valid is None or valid.all() else valid

    def doubt(self) -> str | None:
        """Warning where the intrinsics seem to be of another resolution; None otherwise."""
        off = max(abs(self.pinhole.cx / self.width - 0.5), abs(self.pinhole.cy / self.height - 0.5))
        if off <= FAR_FROM_MIDDLE:
            return None
        return (
            f"{self.described_by}: the principal point is {off:.0%} of the image ({self.lens.width} x "
            f"{self.lens.height}) from its middle: are the intrinsics those of another resolution?"
        )

    def facts(self) -> dict[str, Any]:
        """For provenance: sizes, and intrinsics at the working size."""
        k = self.pinhole
        return {
            "stored_size": [self.lens.width, self.lens.height],
            "size": [self.width, self.height],
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


def rectifications(
    lenses: Mapping[_Key, Lens],
    described_by: Path,
    working_size: Callable[[int, int], tuple[int, int]],
    focal_scale: float = 1.0,
    shows: Bool[np.ndarray, "H W"] | None = None,
) -> dict[_Key, Rectification]:
    """Rectifications of images from many lenses, some of them pinholes, without keeping the maps of all.

    Undistortion maps take some 10 MB each, and COLMAP models often have one camera per image. Lenses are at the size of
    the stored images, which ``described_by`` states; others than pinholes are undistorted to their nominal pinhole, its
    focal length times ``focal_scale``. ``shows`` are the stored pixels with image content.
    """
    undistort = lru_cache(maxsize=_KEPT)(lambda lens, pinhole: Undistortion(lens, pinhole, shows))

    def rectification(lens: Lens) -> Rectification:
        nominal = lens.resized(*working_size(lens.width, lens.height)).pinhole
        if isinstance(lens, PinholeLens):
            return Rectification(lens, nominal, described_by)
        pinhole = replace(nominal, fx=nominal.fx * focal_scale, fy=nominal.fy * focal_scale)
        return Rectification(lens, pinhole, described_by, partial(undistort, lens, pinhole), shows)

    return {key: rectification(lens) for key, lens in lenses.items()}


def whole_frame(lens: Lens, image: Path) -> Lens:
    """The lens at the size of an image of the whole calibrated frame; InputError for crops."""
    width, height = size_of(image)
    if abs((width / height) / (lens.width / lens.height) - 1.0) > ASPECT_TOLERANCE:
        raise InputError(
            f"{image} is {width} x {height}",
            f"the whole raw frame that the lens is calibrated for, {lens.width} x {lens.height} or scaled from it",
            "Undistort cropped images yourself and give them in the undistorted layout",
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
) -> list[Shot]:
    """Frames of one camera, named by their image files behind ``prefix``."""
    return [
        Shot(prefix + image.stem, image, rectification, pose, depth, depth_format)
        for image, pose, depth in zip(images, camera_to_world, depths or (None,) * len(images), strict=True)
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
        stored = self.stored("depth" if name == "depth_at_least" else name)
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

    @override
    def read_all(self) -> dict[str, Tensor]:
        return super().read_all() if self.keep else replace(self, keep=True, _cache={}).read_all()

    def preload(self) -> None:
        """Fill the cache."""
        for name in _READERS:
            self.stored(name)

    def _decoded(self, name: str, stored: Shaped[np.ndarray, "H W ..."]) -> Shaped[np.ndarray, "H W ..."] | None:
        form = self.shot.depth_format
        if name == "depth" and form is not None:
            return form.z_depth(stored) * np.float32(self.scale)
        if name == "depth_at_least" and form is not None:
            bound = form.clipped_at(stored)
            return None if bound is None else bound * np.float32(self.scale)
        return stored.astype(np.float32) / np.float32(255.0) if name == "depth_confidence" else stored

    def stored(self, name: str) -> Shaped[np.ndarray, "H W ..."] | None:
        """A map at the working size, in the stored data type."""
        if not self.keep:
            return _READERS[name](self)
        # If two threads read at the same time, the second overwrites the cache with equal data.
        if name not in self._cache:
            self._cache[name] = _READERS[name](self)
        return self._cache[name]


def _image(pixels: StoredPixels) -> UInt8[np.ndarray, "H W 3"]:
    shot = pixels.shot
    return shot.rectification.resampled("image", shot.image, read_rgb(shot.image))


def _mask(pixels: StoredPixels) -> Bool[np.ndarray, "H W"] | None:
    shot, rectification = pixels.shot, pixels.shot.rectification
    mask = None if shot.mask is None else rectification.resampled("mask", shot.mask, read_mask(shot.mask))
    shown = shot.shown()
    if shown is not None:  # working pixels that mix in the colour of a hidden one are hidden, too
        shown = rectification.image(shown.astype(np.uint8) * 255) == 255
    return all_of(rectification.valid, mask, shown)


def _depth(pixels: StoredPixels) -> Shaped[np.ndarray, "H W"] | None:
    shot = pixels.shot
    if shot.depth is None or shot.depth_format is None:
        return None
    depth = shot.rectification.resampled("depth", shot.depth, shot.depth_format.read(shot.depth))
    mask = pixels.stored("mask")
    return depth if mask is None else np.where(mask, depth, np.zeros((), depth.dtype))


def _seen(pixels: StoredPixels) -> Bool[np.ndarray, "H W"] | None:
    path = pixels.seen_mask
    return None if path is None else pixels.shot.rectification.resampled("seen", path, read_mask(path))


def _confidence(pixels: StoredPixels) -> UInt8[np.ndarray, "H W"] | None:
    path = pixels.shot.confidence
    if path is None:
        return None
    stored = read_gray(path, 8, "a one-channel 8-bit image of the confidence in depth, 255 = 1")
    return pixels.shot.rectification.resampled("depth_confidence", path, stored)


#: Readers of the maps that files hold, by name.
_READERS: Mapping[str, Callable[[StoredPixels], np.ndarray | None]] = {
    "image": _image,
    "depth": _depth,
    "mask": _mask,
    "seen": _seen,
    "depth_confidence": _confidence,
}
