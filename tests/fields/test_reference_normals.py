"""Reference normals: of surfaces with known normals, and of Gaussians that come and go."""

from __future__ import annotations

import math

import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.point_normals import point_normals, wall_normals
from coliags_plugin.fields.explicit_field import ReferenceNormals


def cylinder(turns=120, rings=60, radius=20.0):
    """Points on a cylinder about the z axis, less than 1 mm apart."""
    angles = torch.arange(turns, dtype=torch.float64) * (2 * math.pi / turns)
    heights = torch.arange(rings, dtype=torch.float64) * (2 * math.pi * radius / turns)
    angle, height = torch.meshgrid(angles, heights, indexing="ij")
    outward = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1).reshape(-1, 3)
    return radius * outward + torch.tensor([0.0, 0.0, 1.0]) * height.reshape(-1, 1), outward


@pytest.mark.parametrize("neighbours", [10, 30, 100])
def test_normals_of_a_cylinder(neighbours):
    points, outward = cylinder()
    inner = (points[:, 2] > 8) & (points[:, 2] < points[:, 2].max() - 8)
    cosines = (point_normals(points, neighbours) * outward).sum(1).abs()
    assert math.degrees(math.acos(min(1.0, float(cosines[inner].min())))) < 1.0
    # Where the surface ends the neighbours lie on one side only; the normal stays the surface's within degrees.
    assert math.degrees(math.acos(float(cosines.min()))) < 5


def test_normals_of_a_plane_do_not_depend_on_the_frame():
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(300, 2, generator=generator, dtype=torch.float64), torch.zeros(300, 1)], 1) * 40
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    normals = point_normals(points @ turn.T + 1000.0, 10)
    torch.testing.assert_close((normals @ turn[:, 2]).abs(), torch.ones(300, dtype=torch.float64))
    with pytest.raises(InputError, match=r"10 initial points for normals from 10 neighbours\. Expected at least 11"):
        point_normals(points[:10], 10)


@pytest.mark.parametrize("count", [1, 2, 15, 3000, 40_000])
def test_normals_of_a_noisy_wall(count):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([60.0, 40.0, 0.1])
    at = torch.tensor([[30.0, 20.0, 0.0], [10.0, 10.0, 0.0]], dtype=torch.float64)
    normals = wall_normals(points, at)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(2, dtype=torch.float64))
    if count > 10:
        assert normals[:, 2].abs().min() > math.cos(math.radians(1.5))


def test_new_gaussians_take_the_normal_of_the_nearest_initial_point_and_keep_it():
    points, outward = cylinder()
    references = ReferenceNormals.of_points(points.float(), 10)
    born = points[[5, 700]] + 0.1 * outward[[5, 700]]
    references.extend(torch.cat([points, born]).float())
    torch.testing.assert_close(references.of_rows[-2:], references.normals[[5, 700]])
    keep = torch.ones(len(points) + 2, dtype=torch.bool)
    keep[:700] = False
    references.keep(keep)
    torch.testing.assert_close(references.of_rows[0], references.normals[700])
    torch.testing.assert_close(references.of_rows[-2:], references.normals[[5, 700]])
