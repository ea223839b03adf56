"""Reading and resizing images; truncated files are errors."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Shaped, UInt8

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError


def read_rgb(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Read an 8-bit colour image, without its alpha channel.

    Raises:
        InputError: The file is damaged or has another format.
    """
    image = _read(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise InputError(f"{path} is {_kind(image)}", "an 8-bit RGB image", "Convert it")
    return np.ascontiguousarray(image[..., 2::-1])


def read_gray(path: Path, bits: int, expected: str) -> Shaped[np.ndarray, "H W"]:
    """Read a one-channel image of 8 or 16 bits, as stored.

    Args:
        path: The image.
        bits: Bits per pixel.
        expected: The expected kind of file, for the error.

    Raises:
        InputError: The file is damaged or has another format.
    """
    image = _read(path)
    _check_gray(path, image, bits, expected)
    return image


def _check_gray(path: Path, image: np.ndarray, bits: int, expected: str) -> None:
    if image.dtype != np.dtype(f"uint{bits}") or image.ndim != 2:
        lost = image.dtype == np.uint8 and bits == 16
        raise InputError(
            f"{path} is {_kind(image)}",
            expected,
            "Use the original file: depth converted to 8 bits has lost 0.4 mm" if lost else "Convert it",
        )


def bits_of(path: Path) -> int:
    """Bits per channel of an image file.

    Raises:
        InputError: The image cannot be read completely.
    """
    return 8 * _read(path).itemsize


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image file, pixels.

    Raises:
        InputError: The image cannot be read completely.
    """
    height, width = _read(path).shape[:2]
    return width, height


def _check_size(path: Path, data: bytes) -> None:
    """Refuse what its header says would fill the memory, before anything is decoded."""
    import PIL.Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the decoder says what is wrong with a damaged file
            with PIL.Image.open(io.BytesIO(data)) as header:
                width, height = header.size
    except PIL.Image.DecompressionBombError as error:
        raise InputError(f"{path}: {error}", f"an image of at most {bounds.IMAGE_PIXELS:,} pixels") from error
    except Exception:  # of a kind that Pillow does not know, or damaged: the decoder sees that
        return
    if width * height > bounds.IMAGE_PIXELS or max(width, height) > bounds.IMAGE_SIDE:
        raise InputError(
            f"{path} says that it has {width} x {height} pixels",
            f"at most {bounds.IMAGE_PIXELS:,} pixels, and {bounds.IMAGE_SIDE} a side",
            "It is damaged, or not a frame of a video",
        )


def read_mask(path: Path) -> Shaped[np.ndarray, "H W"]:
    """Read an 8-bit mask, of one channel or of three equal ones: True where it is not black. [H, W]

    Raises:
        InputError: The file is damaged or has another format.
    """
    image = _read(path)
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        if not (image == image[..., :1]).all():
            raise InputError(
                f"{path} is a colour image", "an 8-bit mask: one channel, or three equal ones", "Convert it"
            )
        image = image[..., 0]
    _check_gray(path, image, 8, "an 8-bit mask: one channel, or three equal ones")
    return np.asarray(image > 0)


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


def _read(path: Path) -> np.ndarray:
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a readable image") from error
    # Decoders accept truncated PNGs to different degrees, so the last chunk is checked.
    complete = bool(data) and (not data.startswith(b"\x89PNG") or b"IEND" in data[-64:])
    _check_size(path, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if complete else None
    except cv2.error:  # of more than 2^30 pixels, for instance
        image = None
    if image is None:
        raise InputError(
            f"{path} ({len(data)} bytes) cannot be decoded",
            "a complete image",
            "It is damaged or cut short: fetch it again",
        )
    return cast(np.ndarray, image)


def _kind(image: np.ndarray) -> str:
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"an image of {channels} channel{'s' * (channels > 1)} of {image.dtype}"
