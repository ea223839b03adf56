"""Writes C3VD's undistorted layout: frames, poses and camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.reading.camera_json import write_camera_json
from coliags_plugin.datamanagers.reading.depth_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.scene_settings import POINTS_FILE
from coliags_plugin.geometry.poses.c3vd import matrix_lines

POSES, CAMERA = "camera_pose.txt", "camera.json"
#: 100 mm in 16 bits.
_STEPS_PER_MM = 65535.0 / 100.0


def write_frame(
    folder: Path, index: int, image: UInt8[np.ndarray, "H W 3"], z_depth: Float[np.ndarray, "H W"] | None
) -> None:
    """Write a frame of an undistorted scene (docs/layouts/c3vd.md 3); ``z_depth`` in mm, as for :func:`depth_steps`."""
    write_image(folder / "images" / f"{index:04d}_color.png", image)
    if z_depth is not None:
        write_image(folder / "depths" / f"{index:04d}_depth.png", depth_steps(z_depth))


def write_poses(path: Path, camera_to_world: Float[np.ndarray, "N 4 4"]) -> None:
    """Write a pose file with the release's nine digits; OpenCV axes, mm."""
    atomic_write(path, matrix_lines(camera_to_world, digits=9))


def write_c3vd_scene(
    folder: Path,
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    camera_to_world: Float[np.ndarray, "N 4 4"],
    intrinsics: Intrinsics,
    *,
    depths: Sequence[Float[np.ndarray, "H W"]] | None = None,
    points: PointCloud | None = None,
    overwrite: bool = False,
) -> None:
    """Write a complete undistorted scene with unrounded poses (docs/layouts/c3vd.md 3).

    Args:
        folder: The folder to create.
        images: RGB, all of one size. N of [H, W, 3]
        camera_to_world: Rigid, OpenCV axes, mm. [N, 4, 4]
        intrinsics: Of all images, at their size.
        depths: z-depth, mm, NaN where unknown; 100 mm and more are stored like unknown. N of [H, W]
        points: Initial points, world frame, mm; written to ``points3D.ply``.
        overwrite: Replace an existing folder.

    Raises:
        InputError: The numbers of images, poses and depths differ, or the folder exists or cannot be written.
    """
    if not len(images) == len(camera_to_world) == (len(images) if depths is None else len(depths)):
        raise InputError(
            f"{len(images)} images, {len(camera_to_world)} poses and {'no' if depths is None else len(depths)} depths",
            "equal numbers, or no depths",
        )
    with atomic_folder(folder, overwrite) as scratch:
        for index, image in enumerate(images):
            write_frame(scratch, index, image, None if depths is None else depths[index])
        atomic_write(scratch / POSES, matrix_lines(camera_to_world))
        write_camera_json(scratch / CAMERA, intrinsics, w=intrinsics.width, h=intrinsics.height)
        if points is not None:
            colors = None if points.colors is None else points.colors.numpy()
            write_ply(scratch / POINTS_FILE, point_properties(points.positions.numpy(), colors))


def depth_steps(z_depth: Float[np.ndarray, "H W"]) -> UInt16[np.ndarray, "H W"]:
    """z-depth, mm, in C3VD's encoding: 65535 / 100 steps per mm, 0 where unknown, 65535 from 100 mm on."""
    known = np.isfinite(z_depth) & (z_depth > 0.0)
    steps = np.rint(np.where(known, z_depth, 0.0) * _STEPS_PER_MM)
    return np.where(known, np.clip(steps, 1, C3VD_DEPTH.far), 0).astype(np.uint16)
