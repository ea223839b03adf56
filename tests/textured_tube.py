"""A blind tube with a solid texture, filmed from inside: images with features, and closed-form depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from tests.scenes import write_frames

RADIUS, END = 20.0, 60.0
WIDTH, HEIGHT = 160, 128
#: Off-centre, non-square pixels; pixel centres at integers + 0.5.
INTRINSICS = (101.0, 98.0, 83.0, 61.5)


def depth_along(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Ray lengths to where the wall x^2 + y^2 = RADIUS^2 or the end z = END is. [..., 3] -> [...]"""
    a = (rays[..., :2] ** 2).sum(-1)
    b = (rays[..., :2] * origin[:2]).sum(-1)
    c = (origin[:2] ** 2).sum() - RADIUS**2
    wall = (-b + np.sqrt(b**2 - a * c)) / np.maximum(a, 1e-12)
    return np.minimum(wall, (END - origin[2]) / rays[..., 2])


def texture(points: np.ndarray) -> np.ndarray:
    """RGB in [0, 255] of places in space: waves of 2.5 to 15 mm in all directions. [..., 3] -> [..., 3]"""
    rng = np.random.default_rng(1)
    waves = rng.normal(size=(48, 3))
    waves *= rng.uniform(0.4, 2.5, (48, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    phases, weights = rng.uniform(0, 2 * np.pi, 48), rng.normal(size=(48, 3)) + 1.0
    value = np.sin(points @ waves.T + phases) @ weights
    return np.clip(120.0 + 9.0 * value, 5, 245)


def tube_frames(
    count: int = 10, step: float = 1.6, size: tuple[int, int] = (WIDTH, HEIGHT), coarseness: float = 1.0
) -> list[Frame]:
    """A camera that goes into the tube, ``step`` mm a frame, and sways and turns a little.

    The texture's waves are ``coarseness`` times as long as those of :func:`texture`.
    """
    frames = []
    for index in range(count):
        c2w = np.eye(4)
        turn = [2.0 * index / count, 5.0 * np.sin(index / 3), index]
        c2w[:3, :3] = Rotation.from_euler("xyz", turn, True).as_matrix()
        c2w[:3, 3] = 4.0 * np.sin(index / 2.5), 3.0 * np.cos(index / 3.0), step * index
        camera = Camera(*INTRINSICS, WIDTH, HEIGHT, torch.from_numpy(c2w)).resized(*size)
        rays = camera.rays().numpy()
        depth = depth_along(c2w[:3, 3], rays)
        points = c2w[:3, 3] + depth[..., None] * rays
        image = torch.from_numpy(np.rint(texture(points / coarseness)).astype(np.uint8))
        frames.append(Frame.of(f"{index:04d}", index, image, camera, torch.from_numpy(depth.astype(np.float32))))
    return frames


def write_tube(folder: Path, count: int = 10, step: float = 1.6) -> Path:
    """:func:`tube_frames` in C3VD's undistorted layout, without depth or points."""
    return write_frames(folder, tube_frames(count, step), depth=False)
