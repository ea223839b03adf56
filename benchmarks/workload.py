"""Gaussians strewn over the wall of a tube, seen from inside: work for a renderer without a field behind it."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians

WIDTH, HEIGHT, FOCAL = 338, 270, 200.0
#: The wall: radius and its spread, and where it begins and ends before the camera. Millimetres.
RADIUS, ROUGHNESS, NEAREST, FARTHEST = 20.0, 0.4, 5.0, 100.0
SCALES = (0.2, 1.0)
OPACITIES = (0.1, 0.9)
#: The camera is off the axis and looks past it. Millimetres; radians about x and y.
CENTER = (2.0, -1.0, 0.0)
TILT = (0.06, -0.04)


def wall(count: int, seed: int = 0) -> Gaussians:
    """So many Gaussians at random: scales log-uniform, rotations, opacities and colours uniform.

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
    """The one camera."""
    (sin_x, sin_y), (cos_x, cos_y) = (tuple(map(turn, TILT)) for turn in (math.sin, math.cos))
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos_x, -sin_x], [0.0, sin_x, cos_x]])
    about_y = torch.tensor([[cos_y, 0.0, sin_y], [0.0, 1.0, 0.0], [-sin_y, 0.0, cos_y]])
    pose = torch.eye(4)
    pose[:3, :3] = (about_x @ about_y).T
    pose[:3, 3] = torch.tensor(CENTER)
    return Camera(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, pose)
