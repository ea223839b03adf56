"""Reading and resizing images and depth files; truncated files are errors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from coliags_plugin.core.arrays import read_array
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image, kind_of


def read_gray(path: Path, bits: int, expected: str, floats: bool = False) -> Shaped[np.ndarray, "H W"]:
    """Read a one-channel image of 8 or 16 bits, as stored; ``expected`` is the kind of file, for errors.

    ``floats`` tells whether it may have real numbers instead.
    """
    image = decode_image(path)
    if floats and image.ndim == 2 and image.dtype.kind == "f":
        return image
    if image.dtype != np.dtype(f"uint{bits}") or image.ndim != 2:
        lost = image.dtype == np.uint8 and bits == 16
        raise InputError(
            f"{path} is {kind_of(image)}",
            expected,
            "Use the original file: 8 bits are too few steps of depth" if lost else "Convert it",
        )
    return image


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels."""
    height, width = decode_image(path).shape[:2]
    return width, height


def read_mask(path: Path, colored: bool = False) -> Bool[np.ndarray, "H W"]:
    """Read a mask of 8 or 16 bits: True where it is at least half as bright as white, and not transparent.

    Where all pixels are 0 or of one other value, that one is white, as in masks of 0 and 1. ``colored`` tells whether
    a mask of colours is taken by the brightest channel.
    """
    image = decode_image(path)
    expected = "a mask of 8 or 16 bits: one channel, or three equal ones"
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} is {kind_of(image)}", expected, "Convert it")
    channels = image[..., None] if image.ndim == 2 else image
    values = channels[..., :3].max(axis=2)
    if not colored and (channels[..., :3] != values[..., None]).any():
        raise InputError(f"{path} is a colour image", expected, "Convert it")
    if channels.shape[2] == 4:
        values = np.minimum(values, channels[..., 3])
    top = int(values.max())
    if ((values == 0) | (values == top)).all():
        return np.asarray(values > 0)
    white = 255 if top <= 255 else 65535
    if top <= white // 2:
        raise InputError(
            f"{path}: its values reach from {values.min()} to {top} of {white}",
            "black where pixels are ignored and white elsewhere, or 0 and one other value",
            "Write it anew, or brighter",
        )
    return np.asarray(values > white // 2)


def all_of(*masks: Bool[np.ndarray, "H W"] | None) -> Bool[np.ndarray, "H W"] | None:
    """Pixels that all of several masks of one size have; None without any mask."""
    given = [mask for mask in masks if mask is not None]
    return reduce(np.logical_and, given) if given else None


def resize_rgb(image: UInt8[np.ndarray, "H W *C"], width: int, height: int) -> UInt8[np.ndarray, "h w *C"]:
    """Resize a colour image, or one channel: area averaging to downscale, bilinear to upscale."""
    if image.shape[:2] == (height, width):
        return image
    import cv2

    shrinks = width <= image.shape[1] and height <= image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method))


def resize_nearest(values: Shaped[np.ndarray, "H W"], width: int, height: int) -> Shaped[np.ndarray, "h w"]:
    """Resize by nearest-neighbour sampling at pixel centres."""
    rows, columns = values.shape
    if (rows, columns) == (height, width):
        return values
    row = ((np.arange(height) + 0.5) * rows / height).astype(np.int64)
    column = ((np.arange(width) + 0.5) * columns / width).astype(np.int64)
    return np.ascontiguousarray(values[row[:, None], column[None, :]])


class DepthFormat(ABC):
    """Interface of depth file formats. The stored value 0 means unknown in all of them; undistortion fills it in."""

    @abstractmethod
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """Read the stored values of a file."""

    @abstractmethod
    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Convert stored values to z-depth, scene units; NaN where unknown."""

    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        """Lower bound of z-depth at pixels clipped to the format's range, NaN elsewhere; None if none is clipped."""
        return None


@dataclass(frozen=True)
class DepthSteps(DepthFormat):
    """Numbers proportional to z-depth, unknown where they are not positive: an image of whole steps."""

    size: float  # scene units per step
    bits: int = 16  # 8 or 16
    far: int | None = None  # stored value of depths clipped to the range; None where there is none

    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """See :class:`DepthFormat`; an image of one channel."""
        return read_gray(path, self.bits, f"a one-channel {self.bits}-bit depth image")

    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """See :class:`DepthFormat`."""
        with np.errstate(over="ignore"):
            depth = (stored * self.size).astype(np.float32)
        depth[~(np.isfinite(stored) & (stored > 0))] = np.nan
        if self.far is not None:
            depth[stored == self.far] = np.nan
        return depth

    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        """See :class:`DepthFormat`."""
        if self.far is None or not (clipped := stored == self.far).any():
            return None
        return np.where(clipped, np.float32(self.far * self.size), np.float32(np.nan))


#: C3VD's format: 16 bits for 100 mm, clipped beyond.
C3VD_DEPTH = DepthSteps(100.0 / 65535.0, 16, 65535)


@dataclass(frozen=True)
class InverseDepth(DepthSteps):
    """16-bit inverse depth of 3DGS: z-depth is size / (scale * value / 65536 + offset), unknown where not positive."""

    scale: float = 1.0
    offset: float = 0.0

    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """Read z-depth in units of the model, float32, 0 where it is unknown. [H, W]"""
        stored = super().read(path)
        with np.errstate(over="ignore"):
            inverse = self.scale * (stored / 65536.0) + self.offset
            # The sky, thousands of times as far as the rest, is at no distance.
            known = (inverse > max(0.0, 1e-4 * float(inverse.max()))) & (self.scale > 0.0)
            return np.where(known, 1.0 / np.where(known, inverse, 1.0), 0.0).astype(np.float32)


class DepthArray(DepthSteps):
    """An ``.npy`` array [H, W] or [H, W, 1], or an image of real numbers; 0, negative and not finite mean unknown."""

    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """See :class:`DepthFormat`."""
        if path.suffix.lower() != ".npy":
            kind = f"a one-channel {self.bits}-bit depth image, or one of real numbers"
            return read_gray(path, self.bits, kind, floats=True)
        expected = "an .npy array [H, W] of real numbers"
        array = read_array(path, expected)
        if array.ndim == 3 and array.shape[2] == 1:
            array = array[..., 0]
        real = np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)
        if array.ndim != 2 or not array.size or not real:
            raise InputError(f"{path} is an array {list(array.shape)} of {array.dtype}", expected)
        return np.asarray(array)


def depth_format(path: Path, size: float) -> DepthFormat:
    """Format of a depth file, PNG, TIFF or .npy, whose stored unit is ``size`` scene units."""
    if path.suffix.lower() in (".npz", ".exr"):
        raise InputError(f"{path}: depth in {path.suffix}", "16-bit PNG or TIFF, TIFF of floats, or .npy", "Convert it")
    return DepthArray(size)
