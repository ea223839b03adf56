"""Smoothing of meshes whose shape is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import angles_between
from coliags_plugin.surface.meshing.mending import smoothed
from tests.surface.coverage.tubes import plane


def folded(height: float = 4.0) -> TriangleMesh:
    """A plane of 40 mm in triangles of 0.5 mm with a fold across it, 3 mm wide at half its height."""
    flat = plane(0.0, 20.0, 0.5)
    x = flat.vertices[:, 0]
    return replace(flat, vertices=np.stack([x, flat.vertices[:, 1], height * np.exp(-((x / 1.8) ** 2))], axis=1))


def noisy(mesh: TriangleMesh, deviation: float) -> TriangleMesh:
    noise = np.random.default_rng(0).normal(0.0, deviation, mesh.vertices.shape)
    return replace(mesh, vertices=(mesh.vertices + noise).astype(np.float32))


def inside(mesh: TriangleMesh) -> np.ndarray:
    """Vertices away from the border."""
    return np.abs(mesh.vertices[:, :2]).max(axis=1) < 17


@pytest.mark.parametrize("deviation", [0.03, 0.05])
def test_noise_goes_and_the_fold_stays(deviation):
    truth = folded()
    rough = noisy(truth, deviation)
    smooth = smoothed(rough)
    errors = [angles_between(mesh.normals, truth.normals).mean() for mesh in (rough, smooth)]
    assert errors[1] < 0.3 * errors[0]
    rough_apart, apart = (truth.rays.nearest(mesh.vertices[inside(truth)])[0] for mesh in (rough, smooth))
    assert apart.mean() < 0.8 * rough_apart.mean()
    crest = (np.abs(truth.vertices[:, 0]) < 0.3) & inside(truth)
    assert smooth.vertices[crest, 2].mean() == pytest.approx(4.0, abs=0.15)


def test_surface_without_noise_stays_as_it_is():
    flat = plane(0.0, 20.0, 0.5)
    np.testing.assert_allclose(smoothed(flat).vertices, flat.vertices, atol=1e-5)


def test_smoothing_moves_with_the_mesh_and_scales_with_it():
    rough = noisy(folded(), 0.1)
    moved = replace(rough, vertices=rough.vertices * np.float32(3.0) + np.float32([5, -2, 7]))
    expected = smoothed(rough).vertices * 3.0 + [5, -2, 7]
    np.testing.assert_allclose(smoothed(moved).vertices, expected, atol=0.02)


def test_the_border_does_not_shrink():
    rough = noisy(plane(0.0, 20.0, 0.5), 0.1)
    assert np.abs(smoothed(rough).vertices[:, :2]).max() > 19.9


def test_nothing_to_smooth():
    rough = noisy(folded(), 0.1)
    assert smoothed(rough, 0.0) is rough
    corner = rough.part(np.arange(len(rough)) == 0)
    assert smoothed(corner) is corner
