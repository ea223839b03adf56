"""A straight tube lit by the camera's lamp, in closed form: a scene of any size in a second."""

from __future__ import annotations

import math

import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame, PointCloud, Scene, SparseDepth

RADIUS = 20.0
DEPTH_LIMIT = 100.0


def tube_scene(points: int, frames: int = 16, width: int = 338, height: int = 270, seed: int = 0) -> Scene:
    """A tube of radius 20 mm around the z axis, filmed along 30 mm of it.

    Args:
        points: Initial points on the wall, uniformly at random.
        frames: Training frames.
        width: Pixels.
        height: Pixels.
        seed: Of the points.
    """
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand(points, generator=generator)
    along = (DEPTH_LIMIT + 30.0) * torch.rand(points, generator=generator)
    wall = torch.stack([RADIUS * angle.cos(), RADIUS * angle.sin(), along], dim=1)
    made = [_frame(index, frames, width, height) for index in range(frames)]
    return Scene("tube", made, {"test": made[:1]}, PointCloud(wall), {"fingerprint": f"tube-{points}-{seed}"})


def _frame(index: int, frames: int, width: int, height: int) -> Frame:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([2.0, -1.0, 30.0 * index / frames])
    focal = 200.0 * width / 338.0
    camera = Camera(focal, focal, width / 2, height / 2, width, height, pose)
    rays = camera.rays()
    x, y = camera.center[:2]
    a = rays[..., :2].square().sum(-1)
    b = x * rays[..., 0] + y * rays[..., 1]
    z = ((b.square() + a * (RADIUS**2 - x * x - y * y)).sqrt() - b) / a
    surface = camera.center + z[..., None] * rays
    distance = (surface - camera.center).norm(dim=-1, keepdim=True)
    pattern = 0.5 + 0.4 * torch.sin(surface * torch.tensor([0.9, 1.1, 0.7]))
    rgb = (pattern * (15.0 / distance) ** (2 / 2.2)).clamp(0, 1)
    depth = torch.where(z < DEPTH_LIMIT, z, torch.nan)
    return Frame(
        f"{index:04d}", index, (rgb * 255).round().byte(), camera, depth, sparse_depth=_at_every_eighth_pixel(depth)
    )


def _at_every_eighth_pixel(depth: torch.Tensor) -> SparseDepth:
    row, column = torch.meshgrid(*(torch.arange(4, size, 8) for size in depth.shape), indexing="ij")
    known = torch.isfinite(depth[row, column])
    return SparseDepth(torch.stack([column[known], row[known]], dim=1) + 0.5, depth[row, column][known])
