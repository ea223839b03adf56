"""A straight tube: as a scene of any size, in closed form, and as Gaussians strewn over its wall."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.core.scenes import Frame, PointCloud, Scene, SparseDepth

RADIUS = 20.0
DEPTH_LIMIT = 100.0
WIDTH, HEIGHT, FOCAL = 338, 270, 200.0
#: Of strewn Gaussians: spread of their radius, and where they begin and end before the camera. Millimetres.
ROUGHNESS, NEAREST, FARTHEST = 0.4, 5.0, 100.0
SCALES = (0.2, 1.0)
OPACITIES = (0.1, 0.9)
#: Their camera is off the axis and looks past it. Millimetres; radians about x and y.
CENTER = (2.0, -1.0, 0.0)
TILT = (0.06, -0.04)


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
    return Scene("tube", made, {"test": made[:1]}, PointCloud(wall), Provenance(fingerprint=f"tube-{points}-{seed}"))


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
    return Frame.of(
        f"{index:04d}", index, (rgb * 255).round().byte(), camera, depth, sparse_depth=_at_every_eighth_pixel(depth)
    )


def _at_every_eighth_pixel(depth: torch.Tensor) -> SparseDepth:
    row, column = torch.meshgrid(*(torch.arange(4, size, 8) for size in depth.shape), indexing="ij")
    known = torch.isfinite(depth[row, column])
    return SparseDepth(torch.stack([column[known], row[known]], dim=1) + 0.5, depth[row, column][known])


def wall(count: int, seed: int = 0) -> Gaussians:
    """So many Gaussians strewn over the wall at random: scales log-uniform, rotations, opacities and colours uniform.

    Their scales do not depend on how many there are, so the wall gets denser with them and every pixel sees more.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    angle = uniform(0.0, 2 * math.pi, count)
    radius = RADIUS + ROUGHNESS * torch.randn(count, generator=generator)
    means = torch.stack([radius * angle.cos(), radius * angle.sin(), uniform(NEAREST, FARTHEST, count)], dim=1)
    scales = uniform(math.log(SCALES[0]), math.log(SCALES[1]), count, 3).exp()
    quats = torch.randn(count, 4, generator=generator)
    index = torch.arange(count)
    return Gaussians(means, quats, scales, uniform(*OPACITIES, count), uniform(0.0, 1.0, count, 3), index, index)


def lining(count: int, seed: int = 0) -> Gaussians:
    """The same, but lying in the wall with their third axis across it, and from behind the camera on.

    So trained ones lie, and those beside the camera reach across its near plane.
    """
    made = wall(count, seed)
    x, y, z = made.means.unbind(1)
    share = (z - NEAREST) / (FARTHEST - NEAREST)
    means = torch.stack([x, y, share * (FARTHEST + NEAREST) - NEAREST], dim=1)
    # A quarter turn of the third axis to the radius, after any turn about it.
    angle, turn = torch.atan2(y, x), 0.5 * made.quats_wxyz[:, 0]
    quats = torch.stack([turn.cos(), (turn - angle).sin(), (turn - angle).cos(), turn.sin()], dim=1)
    return replace(made, means=means, quats_wxyz=quats)


def camera() -> Camera:
    """The one camera of strewn Gaussians."""
    (sin_x, sin_y), (cos_x, cos_y) = (tuple(map(turn, TILT)) for turn in (math.sin, math.cos))
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos_x, -sin_x], [0.0, sin_x, cos_x]])
    about_y = torch.tensor([[cos_y, 0.0, sin_y], [0.0, 1.0, 0.0], [-sin_y, 0.0, cos_y]])
    pose = torch.eye(4)
    pose[:3, :3] = (about_x @ about_y).T
    pose[:3, 3] = torch.tensor(CENTER)
    return Camera(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, pose)
