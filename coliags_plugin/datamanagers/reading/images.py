"""Reading and resizing images; truncated files are errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import decode_image, kind_of


def read_gray(path: Path, bits: int, expected: str, channels_repeat: bool = False) -> Shaped[np.ndarray, "H W"]:
    """Read a one-channel image of 8 or 16 bits, as stored; ``expected`` is the kind of file, for errors.

    ``channels_repeat`` tells whether it may have three equal channels instead.
    """
    image = decode_image(path)
    if channels_repeat and image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.dtype(f"uint{bits}"):
        if not (image == image[..., :1]).all():
            raise InputError(f"{path} is a colour image", expected, "Convert it")
        image = image[..., 0]
    if image.dtype != np.dtype(f"uint{bits}") or image.ndim != 2:
        lost = image.dtype == np.uint8 and bits == 16
        raise InputError(
            f"{path} is {kind_of(image)}",
            expected,
            "Use the original file: depth converted to 8 bits has lost 0.4 mm" if lost else "Convert it",
        )
    return image


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels."""
    height, width = decode_image(path).shape[:2]
    return width, height


def read_mask(path: Path) -> Shaped[np.ndarray, "H W"]:
    """Read an 8-bit mask, of one channel or of three equal ones: True where it is not black."""
    return np.asarray(read_gray(path, 8, "an 8-bit mask: one channel, or three equal ones", channels_repeat=True) > 0)


def resize_rgb(image: UInt8[np.ndarray, "H W 3"], width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Resize a colour image: area averaging to downscale, bilinear to upscale."""
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
