"""Writes scenes in TUM's RGB-D layout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.reading.camera_json import write_camera_json
from coliags_plugin.datamanagers.rgbd.files import is_time, times
from coliags_plugin.datamanagers.units import Unit, write_unit
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.trajectory import Trajectory

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


def write_rgbd_scene(
    folder: Path,
    frames: Sequence[Frame],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    *,
    unit: Unit = "unknown",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Write a scene that the ``rgbd`` data manager reads without options (docs/layouts/rgbd.md 1).

    Frames named by timestamps (docs/layouts/rgbd.md) keep their names, and the trajectory has these timestamps; others
    are numbered, and their numbers are the timestamps. Masks are written for frames that have one. The depth step is
    the smallest of 1, 1/2, 1/5, 1/10, ... whose 16-bit range contains the largest depth.

    Args:
        folder: The folder to create.
        frames: In video order, all of one camera; their poses are not used.
        camera_to_world: Rigid, OpenCV axes, the unit of the depth. [N, 4, 4]
        unit: Of lengths.
        overwrite: Replace an existing folder.
        progress: Progress callback.

    Returns:
        The trajectory's file.

    Raises:
        InputError: There are no frames; the number of poses differs; a frame has no depth, or another camera; or the
            folder exists or cannot be written.
    """
    if not frames or len(frames) != len(camera_to_world):
        raise InputError(f"{len(frames)} frames and {len(camera_to_world)} poses", "one pose for each frame")
    intrinsics = frames[0].camera.intrinsics
    scale = depth_scale(max(_farthest(frame) for frame in frames))
    names = [f"{frame.name}.png" for frame in frames]
    timed = all(is_time(frame.name) for frame in frames) and bool(
        (np.diff(times([Path(name) for name in names])) > 0.0).all()
    )
    if not timed:
        names = [f"{index:04d}.png" for index in range(len(frames))]
    with atomic_folder(folder, overwrite) as scratch:
        for name, frame in zip(names, with_progress(frames, "write frames", progress), strict=True):
            if frame.camera.intrinsics != intrinsics:
                raise InputError(f"frame {frame.name} has another camera", "one pinhole for all frames")
            mask = None if frame.mask is None else frame.mask.numpy()
            write_frame(scratch, name, frame.image.numpy(), _depth(frame), scale, mask)
        tum.write(scratch / TRAJECTORY, Trajectory(camera_to_world, timestamps=times([Path(name) for name in names])))
        k = intrinsics
        write_camera_json(scratch / CAMERA, k, w=k.width, h=k.height, depth_scale=scale)
        write_unit(scratch, unit)
    return folder / TRAJECTORY


def depth_scale(farthest: float) -> float:
    """Steps per unit of length: the largest of 1, 2, 5 times a power of ten for which the depth fits into 16 bits."""
    finest = _LARGEST / farthest
    power = 10.0 ** np.floor(np.log10(finest))
    return float(next(power * digit for digit in (5, 2, 1) if power * digit <= finest))


def depth_steps(depth: Float[np.ndarray, "H W"], scale: float) -> UInt16[np.ndarray, "H W"]:
    """z-depth in 16-bit steps; 0 where unknown or out of range."""
    known = np.isfinite(depth) & (depth > 0.0)
    steps = np.maximum(np.rint(np.where(known, depth, 0.0) * scale), 1)
    return np.where(known & (steps <= _LARGEST), steps, 0).astype(np.uint16)


def _depth(frame: Frame) -> Float[np.ndarray, "H W"]:
    depth = frame.depth
    if depth is None:
        raise InputError(f"frame {frame.name} has no depth", "depth for every frame")
    return depth.numpy().astype(np.float64)


def _farthest(frame: Frame) -> float:
    depth = _depth(frame)
    known = depth[np.isfinite(depth)]
    return float(known.max(initial=1e-9))
