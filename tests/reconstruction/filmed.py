"""A printed wall, filmed: every motion is known, and depth has a closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.reconstruction.odometry.frames import RgbdFrame
from tests.textured_tube import texture

#: Off-centre, and pixels that are not square.
PINHOLE = Intrinsics(101.0, 98.0, 83.0, 61.5, 160, 128)
#: The wall is where NORMAL . x = OFFSET (mm), with a dent in it unless it is flat.
NORMAL, OFFSET = np.array([0.2, -0.1, 1.0]), 40.0

Lamp = Callable[[int, np.ndarray], np.ndarray]


def swaying(count: int, step: float = 0.5) -> np.ndarray:
    """A camera that moves sideways and forward, and turns by half a degree a frame. [N, 4, 4]"""
    poses = np.tile(np.eye(4), (count, 1, 1))
    along = np.arange(count)
    poses[:, :3, 3] = step * np.stack([along, 2.0 * np.sin(along / 3.0), 0.6 * along], axis=1)
    turns = 0.5 * np.stack([np.sin(along / 2.0), along, 0.5 * along], axis=1)
    poses[:, :3, :3] = Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
    return poses


def filmed_wall(poses: np.ndarray, lamp: Lamp | None = None) -> list[RgbdFrame]:
    """The wall as cameras see it.

    Args:
        poses: Camera-to-world. [N, 4, 4]
        lamp: Factor on the image's brightness from the frame's number and the distance of each pixel.
    """
    x = (np.arange(PINHOLE.width) + 0.5 - PINHOLE.cx) / PINHOLE.fx
    y = (np.arange(PINHOLE.height) + 0.5 - PINHOLE.cy) / PINHOLE.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((PINHOLE.height, PINHOLE.width))], axis=-1)
    frames = []
    for index, pose in enumerate(poses):
        world = rays @ pose[:3, :3].T
        depth = (OFFSET - NORMAL @ pose[:3, 3]) / (world @ NORMAL)
        color = texture(pose[:3, 3] + depth[..., None] * world)
        if lamp is not None:
            color = np.clip(color * lamp(index, depth * np.linalg.norm(rays, axis=-1))[..., None], 0, 255)
        frames.append(RgbdFrame(f"{index:04d}", np.rint(color).astype(np.uint8), depth.astype(np.float32)))
    return frames
