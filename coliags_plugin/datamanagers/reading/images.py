"""Reading and resizing images and masks; truncated files are errors."""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped, UInt8

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
    present = [mask for mask in masks if mask is not None]
    return reduce(np.logical_and, present) if present else None


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
