"""Radiosity of walls whose form factors are known."""

from __future__ import annotations

import math

import pytest
import torch

from coliags_plugin.lighting.photometry import Cavity


def sphere(count, radius):
    """Points spread evenly over a sphere, and normals that point to its centre."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1.0 - 2.0 * index / count, math.pi * (1.0 + math.sqrt(5.0)) * index
    across = (1.0 - height.square()).sqrt()
    outward = torch.stack([across * turn.cos(), across * turn.sin(), height], dim=-1)
    return radius * outward, -outward


@pytest.mark.parametrize("albedo", [0.0, 0.3, 0.5])
def test_a_sphere_lights_every_point_alike(albedo):
    """In a sphere, the form factor of a patch is its share of the area: irradiance of all, from any light."""
    points, normals = sphere(2400, 25.0)
    cavity = Cavity.of(points, normals)
    direct = torch.zeros(len(points[:: cavity.every]), 2, dtype=torch.float64)
    direct[:, 0], direct[:100, 1] = 3.0, 5.0
    found = cavity.indirect(direct, albedo)
    reflections = sum(albedo**bounce for bounce in range(1, 6))
    expected = reflections * direct.mean(0).expand_as(found)
    torch.testing.assert_close(found[:, 0], expected[:, 0], rtol=0.05, atol=1e-9)
    # Near patches are discs, not points: a few points are nearly on one.
    torch.testing.assert_close(found[:, 1].median(), expected[0, 1], rtol=0.05, atol=1e-9)


def test_what_is_flat_or_faces_away_gets_nothing():
    grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).double()
    flat = torch.cat([grid, torch.zeros(400, 1, dtype=torch.float64)], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(400, 3)
    direct = torch.ones(400, 1, dtype=torch.float64)
    assert Cavity.of(flat, up).indirect(direct, 0.5).abs().max() == 0.0
    points, normals = sphere(400, 10.0)
    assert Cavity.of(points, -normals).indirect(direct, 0.5).abs().max() == 0.0


def test_few_points():
    points, normals = sphere(3, 10.0)
    assert Cavity.of(points, normals).indirect(torch.ones(3, 1, dtype=torch.float64), 0.5).isfinite().all()
