"""A tilted wall with a printed pattern, written in C3VD's layouts: every depth and colour has a closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.datamanagers.c3vd.writer import depth_steps, write_c3vd_scene
from coliags_plugin.geometry.lenses.models import LENSES, Lens, PinholeLens, octagon_mask

#: The wall is where NORMAL . x = OFFSET (mm).
NORMAL = np.array([0.2, -0.1, 1.0])
OFFSET = 40.0
#: Off-centre and not square, so that whoever confuses something is caught.
PINHOLE = Intrinsics(61.0, 55.0, 33.5, 21.5, 64, 48)


def poses(count: int) -> np.ndarray:
    """Cameras that look at the wall, each from elsewhere and turned differently. [N, 4, 4]"""
    result = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        turn = np.array([0.02 * index, -0.05 + 0.01 * index, 0.3])
        result[index, :3, :3] = cv2.Rodrigues(turn)[0]
        result[index, :3, 3] = [1.0 + index, 2.0 - 0.5 * index, 3.0 + 0.7 * index]
    return result


def look(camera_to_world: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and colour along camera directions with z = 1. [..., 3] -> [...], [..., 3]"""
    world = directions @ camera_to_world[:3, :3].T
    depth = (OFFSET - NORMAL @ camera_to_world[:3, 3]) / (world @ NORMAL)
    points = camera_to_world[:3, 3] + depth[..., None] * world
    return depth, colors(points)


def colors(points: np.ndarray) -> np.ndarray:
    """The wall's pattern: smooth, so that resampling it costs little. [..., 3]"""
    waves = np.stack([points[..., 0] / 9.0, points[..., 1] / 7.0, (points[..., 0] + points[..., 1]) / 11.0], -1)
    return np.rint(128.0 + 100.0 * np.sin(np.nan_to_num(waves))).astype(np.uint8)


def off_wall(points: np.ndarray) -> np.ndarray:
    """Distance from the wall, mm. [N, 3] -> [N]"""
    return np.abs(points @ NORMAL - OFFSET) / np.linalg.norm(NORMAL)


def rays(camera: Lens | Intrinsics) -> np.ndarray:
    """Directions of the pixels, z = 1. [H, W, 3]"""
    lens = camera if isinstance(camera, Lens) else PinholeLens.of(camera)
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return lens.unproject(np.stack([columns.ravel(), rows.ravel()], 1)).reshape(lens.height, lens.width, 3)


def write_undistorted(folder: Path, count: int = 9, width: int = 64, height: int = 48, **options) -> Path:
    """The wall in the undistorted layout."""
    intrinsics = replace(PINHOLE, width=width, height=height)
    directions = rays(intrinsics)
    views = [look(pose, directions) for pose in poses(count)]
    depths = options.pop("depths", [depth for depth, _ in views])
    write_c3vd_scene(folder, [color for _, color in views], poses(count), intrinsics, depths=depths, **options)
    return folder


def write_raw(
    folder: Path, lens: Lens | None = None, count: int = 9, row_major: bool = False, padded: bool = True
) -> Path:
    """The wall in the raw layout, dark outside the octagon."""
    lens = lens or LENSES["omnidirectional"].resized(270, 216)
    directions = rays(lens)
    octagon = octagon_mask(lens.width, lens.height)
    folder.mkdir(parents=True)
    for index, pose in enumerate(poses(count)):
        depth, color = look(pose, directions)
        number = f"{index:04d}" if padded else str(index)
        cv2.imwrite(str(folder / f"{number}_color.png"), np.where(octagon[..., None], color, 0)[..., ::-1])
        steps = np.where(octagon, depth_steps(depth), 0).astype(np.uint16)
        cv2.imwrite(str(folder / f"{index:04d}_depth.tiff"), steps)
    matrices = poses(count) if row_major else poses(count).transpose(0, 2, 1)
    lines = [",".join(f"{number:.9g}" for number in matrix.ravel()) for matrix in matrices]
    (folder / "pose.txt").write_text("\n".join(lines) + "\n")
    return folder
