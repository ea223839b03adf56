"""Writes scenes in TUM's RGB-D layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from coliags_plugin.core.images import write_image, write_mask

#: Largest 16-bit value.
_LARGEST = 65_535
TRAJECTORY, CAMERA = "trajectory.txt", "camera.json"


def write_frame(
    folder: Path,
    name: str,
    image: UInt8[np.ndarray, "H W 3"],
    z_depth: Float[np.ndarray, "H W"],
    scale: float,
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> None:
    """Write an image, its depth and its optional mask (True where a pixel counts) under the same file name.

    The name is a timestamp in seconds or a number. ``z_depth`` is as for :func:`depth_steps`; ``scale`` in steps per
    unit of length.
    """
    write_image(folder / "rgb" / name, image)
    write_image(folder / "depth" / name, depth_steps(z_depth, scale))
    if mask is not None:
        write_mask(folder / "mask" / name, mask)


def depth_steps(depth: Float[np.ndarray, "H W"], scale: float) -> UInt16[np.ndarray, "H W"]:
    """z-depth in 16-bit steps; 0 where unknown or out of range."""
    known = np.isfinite(depth) & (depth > 0.0)
    steps = np.maximum(np.rint(np.where(known, depth, 0.0) * scale), 1)
    return np.where(known & (steps <= _LARGEST), steps, 0).astype(np.uint16)
