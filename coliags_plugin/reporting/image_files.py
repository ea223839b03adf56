"""Images as PNG, JPEG and WebP, and depth maps as float32 TIFF, without silent conversions."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import decode_image, encode_image

if TYPE_CHECKING:
    from torch import Tensor

# Tag values of the TIFF 6.0 specification and its supplement.
_TIFF_DEFLATE = 8
_TIFF_NO_PREDICTOR = 1
# OpenCV's code: a quality above 100.
_WEBP_LOSSLESS = 101


def as_array(values: np.ndarray | Tensor) -> np.ndarray:
    """NumPy array of an array or tensor on any device, with or without a gradient; shares memory where possible."""
    if isinstance(values, np.ndarray):
        return values
    return np.asarray(values.detach().cpu().numpy())


def eight_bit(rgb: Tensor) -> Tensor:
    """Colours in [0, 1] as uint8, clamped and rounded. [H, W, 3]"""
    return (rgb.clamp(0.0, 1.0) * 255.0).round().byte()


@dataclass(frozen=True)
class EncodedImage:
    """An image file with its size, px."""

    data: bytes
    suffix: str  # its kind: ``.png``, ``.jpg`` or ``.webp``
    width: int  # px
    height: int  # px

    @classmethod
    def png(cls, rgb: UInt8[np.ndarray, "H W 3"] | Tensor) -> EncodedImage:
        """An 8-bit RGB image as PNG."""
        return cls._encoded(checked_rgb(rgb), ".png")

    @classmethod
    def jpeg(
        cls, rgb: UInt8[np.ndarray, "H W 3"] | Tensor, quality: int = 95, width: int | None = None
    ) -> EncodedImage:
        """An 8-bit RGB image as JPEG, reduced to a width in px if wider; quality 1 to 100.

        Chroma is not subsampled, which would visibly degrade red mucosa.
        """
        image = checked_rgb(rgb)
        if width is not None and image.shape[1] > width:
            size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        sampling = int(cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
        options = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling)
        return cls._encoded(image, ".jpg", options)

    @classmethod
    def webp(cls, rgb: UInt8[np.ndarray, "H W 3"] | Tensor) -> EncodedImage:
        """An 8-bit RGB image as WebP without loss: a third of a PNG's size for colour-mapped images."""
        return cls._encoded(checked_rgb(rgb), ".webp", (cv2.IMWRITE_WEBP_QUALITY, _WEBP_LOSSLESS))

    @classmethod
    def _encoded(cls, image: np.ndarray, suffix: str, options: Sequence[int] = ()) -> EncodedImage:
        return cls(encode_image(image, suffix, options), suffix, image.shape[1], image.shape[0])

    @property
    def uri(self) -> str:
        """Data URI with the whole image."""
        kind = "jpeg" if self.suffix == ".jpg" else self.suffix.removeprefix(".")
        return f"data:image/{kind};base64,{b64encode(self.data).decode('ascii')}"


def write_png(path: Path, rgb: UInt8[np.ndarray, "H W 3"] | Tensor) -> None:
    """Write an 8-bit RGB PNG atomically; its folder is created."""
    atomic_write(path, encode_image(checked_rgb(rgb)))


def write_depth_tiff(path: Path, depth_mm: Float32[np.ndarray, "H W"] | Tensor) -> None:
    """Write a depth map of any kind, mm, as a one-channel float32 TIFF, atomically. NaN is preserved."""
    depth = as_array(depth_mm)
    if depth.ndim != 2 or depth.size == 0 or not np.issubdtype(depth.dtype, np.floating):
        raise InputError(f"cannot write {_kind(depth)} to {path}", "a depth map: floating point, [H, W]")
    # cv2's default, LZW with a floating-point predictor, is not read by many libraries (tifffile needs a plug-in).
    options = [cv2.IMWRITE_TIFF_COMPRESSION, _TIFF_DEFLATE, cv2.IMWRITE_TIFF_PREDICTOR, _TIFF_NO_PREDICTOR]
    atomic_write(path, encode_image(depth.astype(np.float32), ".tiff", options))


def read_depth_tiff(path: Path) -> Float32[np.ndarray, "H W"]:
    """Read a one-channel float32 TIFF in mm. [H, W]"""
    depth = decode_image(path)
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise InputError(f"{path} holds {_kind(depth)}", "one channel of float32, mm")
    return depth


def checked_rgb(rgb: np.ndarray | Tensor, name: str = "an image") -> UInt8[np.ndarray, "H W 3"]:
    """Pixels that are checked to be an 8-bit RGB image."""
    pixels = as_array(rgb)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise InputError(f"{name} is {_kind(pixels)}", "8-bit RGB, uint8 [H, W, 3]")
    return pixels


def _kind(pixels: np.ndarray) -> str:
    return f"{pixels.dtype} {list(pixels.shape)}"
