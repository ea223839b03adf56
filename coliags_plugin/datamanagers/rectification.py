"""Rectification of stored images: undistortion to a pinhole camera and resizing to the working size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.datamanagers.reading.images import resize_nearest, resize_rgb
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

    def sampled(self, path: Path, values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "h w"]:
        """Values of a file as :meth:`nearest`, after a check of its size as :meth:`checked`."""
        return self.nearest(self.checked(path, values))

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
    height, width = read_rgb(image).shape[:2]
    if abs((width / height) / (lens.width / lens.height) - 1.0) > ASPECT_TOLERANCE:
        raise InputError(
            f"{image} is {width} x {height}",
            f"the whole raw frame that the lens is calibrated for, {lens.width} x {lens.height} or scaled from it",
            "Undistort cropped images yourself and give them in the undistorted layout",
        )
    return lens.resized(width, height)
