"""Reading and resizing pictures. What cannot be read whole is not read at all."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float32, Shaped, UInt8, UInt16

from coliags_plugin.errors import InputError

#: mm per step of C3VD's 16-bit depth, and the two values that mean "unknown": nothing there, and 100 mm or more.
DEPTH_MM_PER_STEP = 100.0 / 65535.0
DEPTH_INVALID = (0, 65535)


def read_rgb(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """An 8-bit colour picture; an alpha channel is dropped.

    Raises:
        InputError: It cannot be read whole, or is something else.
    """
    image = _read(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise InputError(f"{path} is {_kind(image)}", "an 8-bit RGB picture", "Convert it")
    return np.ascontiguousarray(image[..., 2::-1])


def read_depth_steps(path: Path) -> UInt16[np.ndarray, "H W"]:
    """A 16-bit depth picture as stored; :func:`millimetres` converts it.

    Raises:
        InputError: It cannot be read whole, or is something else.
    """
    depth = _read(path)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise InputError(
            f"{path} is {_kind(depth)}",
            "a one-channel 16-bit depth picture, 65535 being 100 mm",
            "Take the original file: depth that went through 8 bits has lost 0.4 mm",
        )
    return depth


def read_mask(path: Path) -> Shaped[np.ndarray, "H W"]:
    """An 8-bit one-channel picture as a mask: True where it is not black. [H, W]

    Raises:
        InputError: It cannot be read whole, or is something else.
    """
    mask = _read(path)
    if mask.dtype != np.uint8 or mask.ndim != 2:
        raise InputError(f"{path} is {_kind(mask)}", "a one-channel 8-bit mask", "Convert it")
    return mask > 0


def millimetres(steps: UInt16[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """z-depth, mm, of C3VD's 16-bit depth; NaN where unknown (docs/data.md 1). [H, W]"""
    depth = (steps * DEPTH_MM_PER_STEP).astype(np.float32)
    depth[np.isin(steps, DEPTH_INVALID)] = np.nan
    return depth


def clipped_at(steps: UInt16[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
    """The z-depth at which C3VD's 16 bits end, mm, where they do; NaN elsewhere. None where none did. [H, W]"""
    _, far = DEPTH_INVALID
    clipped = steps == far
    return np.where(clipped, np.float32(far * DEPTH_MM_PER_STEP), np.float32(np.nan)) if clipped.any() else None


def resize_rgb(image: UInt8[np.ndarray, "H W 3"], width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """A colour picture at another size: averaged over areas when it shrinks, bilinear when it grows."""
    if image.shape[:2] == (height, width):
        return image
    import cv2

    shrinks = width <= image.shape[1] and height <= image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method))


def resize_nearest(values: Shaped[np.ndarray, "H W"], width: int, height: int) -> Shaped[np.ndarray, "h w"]:
    """Values at another size, each from the pixel under its centre, so that none are mixed."""
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
        raise InputError(f"cannot read {path}: {error.strerror or error}", "a readable picture") from error
    # Decoders differ in what they make of half a PNG; its last chunk says whether it is whole.
    whole = bool(data) and (not data.startswith(b"\x89PNG") or b"IEND" in data[-64:])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if whole else None
    if image is None:
        raise InputError(
            f"{path} ({len(data)} bytes) cannot be decoded",
            "a whole picture",
            "It is damaged or cut short: fetch it again",
        )
    return cast(np.ndarray, image)


def _kind(image: np.ndarray) -> str:
    channels = 1 if image.ndim == 2 else image.shape[2]
    return f"a picture of {channels} channel{'s' * (channels > 1)} of {image.dtype}"
