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
    row, column = torch.meshgrid(torch.arange(0, height, 16), torch.arange(0, width, 16), indexing="ij")
    at = torch.stack([column, row], dim=-1)[depth[row, column].isfinite()]
    points = SparseDepth(at + 0.5, depth[at[:, 1], at[:, 0]])
    return Frame(f"{index:04d}", index, (rgb * 255).round().byte(), camera, depth, sparse_depth=points)
