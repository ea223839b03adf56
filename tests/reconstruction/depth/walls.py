"""A textured plane seen by moving cameras: exact depth at every pixel."""

from __future__ import annotations

import numpy as np
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from tests.textured_tube import texture

NORMAL, OFFSET = np.array([0.15, -0.1, 1.0]), 40.0
INTRINSICS = (60.0, 58.0, 49.0, 39.0, 96, 80)


def sideways(count: int, step: float = 2.0) -> np.ndarray:
    """Poses of a camera that moves sideways and a little forward, looking ahead. [N, 4, 4]"""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = step * np.arange(count)[:, None] * np.array([1.0, 0.3, 0.2])
    return poses


def wall_depth(camera: Camera) -> np.ndarray:
    """z-depth of the plane NORMAL . x = OFFSET. [H, W]"""
    pose = camera.camera_to_world.double().numpy()
    rays = camera.rays().double().numpy()
    return (OFFSET - NORMAL @ pose[:3, 3]) / (rays @ NORMAL)


def wall_frames(poses: np.ndarray) -> list[Frame]:
    """The plane, with waves of 5 to 30 mm, as cameras see it."""
    frames = []
    for index, pose in enumerate(poses):
        camera = Camera(*INTRINSICS, torch.from_numpy(pose))
        points = pose[:3, 3] + wall_depth(camera)[..., None] * camera.rays().numpy()
        image = np.rint(0.5 * texture(points / 2.0) + 40.0).astype(np.uint8)
        frames.append(Frame.of(f"{index:04d}", index, torch.from_numpy(image), camera))
    return frames
