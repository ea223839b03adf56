"""Encoding of images as PNG, JPEG and TIFF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write


def encode_image(pixels: np.ndarray, suffix: str = ".png", options: Sequence[int] = ()) -> bytes:
    """Encode an image as the bytes of a file.

    Args:
        pixels: RGB or one channel, of a type that the format holds. [H, W, 3] or [H, W]
        suffix: Of the format, with its dot.
        options: OpenCV's keys and values, one after the other.

    Raises:
        InputError: The format cannot hold these pixels.
    """
    import cv2

    kind = f"{pixels.dtype} {list(pixels.shape)}"
    bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    try:
        encoded, data = cv2.imencode(suffix, np.ascontiguousarray(bgr), list(options))
    except cv2.error as error:
        raise InputError(f"a {kind} image cannot be written as {suffix}: {error}") from error
    if not encoded:
        raise InputError(f"a {kind} image cannot be written as {suffix}")
    return bytes(data)


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write an image atomically in the format of its suffix; its folder is made.

    Args:
        path: Where to.
        pixels: RGB or one channel. [H, W, 3] or [H, W]

    Raises:
        InputError: The format cannot hold these pixels, or the folder cannot be written.
    """
    atomic_write(path, encode_image(pixels, path.suffix))


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write a mask as one channel of 8 bits: 255 where it is True, 0 elsewhere. [H, W]

    Raises:
        InputError: The folder cannot be written.
    """
    write_image(path, mask.astype(np.uint8) * 255)
