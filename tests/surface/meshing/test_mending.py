"""Mending of meshes of known shape: holes, whether they are closed, and smoothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import angles_between
from coliags_plugin.surface.meshing.mending import close_holes, loops, smoothed
from coliags_plugin.surface.meshing.views import DepthView
from tests.scenes import camera_at
from tests.surface.coverage.tubes import joined, plane

WHOLE = plane(20.0, 8.0, 0.5)


def without(mesh: TriangleMesh, *centers: tuple[float, float], radius: float = 1.4) -> TriangleMesh:
    """The mesh with holes about such x and y."""
    apart = [np.linalg.norm(mesh.centers[:, :2] - center, axis=1) > radius for center in centers]
    return mesh.part(np.all(apart, axis=0))


def view(depth: float = 20.0) -> DepthView:
    """A view along z from the origin, of a wall at such a depth."""
    camera = camera_at(0.0, 0.0, 0.0, 60, 40)
    return DepthView(camera, torch.full((40, 60), depth), torch.ones(40, 60), lambda: None)


def test_the_wall_goes_on_as_it_bends():
    """The middle of the hole in a sphere of 15 mm is 0.1 mm off the plane of its rim, and less off the sphere."""
    x, y = WHOLE.vertices[:, :2].T
    bent = replace(WHOLE, vertices=np.stack([x, y, 5.0 + np.sqrt(15.0**2 - x**2 - y**2)], axis=1).astype(np.float32))
    closed, count = close_holes(without(bent, (0.0, 0.0), radius=2.0), 20.0, [view()])
    new = np.linalg.norm(closed.vertices[:, :2], axis=1) < 1.7
    off = np.linalg.norm(closed.vertices[new] - [0.0, 0.0, 5.0], axis=1) - 15.0
    assert count == 1 and np.abs(off).max() < 0.06


def test_what_is_larger_stays_open():
    large = without(WHOLE, (0.0, 0.0), radius=4.0)
    assert close_holes(large, 15.0, [view()]) == (large, 0)
    assert close_holes(large, 0.0, [view()]) == (large, 0)
    assert close_holes(WHOLE, 15.0, [view()]) == (WHOLE, 0)


@pytest.mark.parametrize(
    ("views", "closed"),
    [
        ([], False),
        ([view(30.0)], False),
        ([view(), view(30.0)], False),
        ([view(), view(), view(30.0)], True),
        ([view(10.0)], False),
        ([view(), view(10.0), view(0.0)], True),
    ],
    ids=["not seen", "seen through", "as often as seen", "less often", "hidden", "seen by one"],
)
def test_a_hole_is_closed_where_more_views_see_wall_than_see_through_it(views, closed):
    assert close_holes(without(WHOLE, (0.0, 0.0)), 15.0, views)[1] == closed


def test_each_hole_is_judged_for_itself():
    half = view()
    half = replace(half, depth=torch.where(torch.arange(60) < 30, 20.0, 0.0).expand(40, 60))
    closed, count = close_holes(without(WHOLE, (-4.0, 0.0), (4.0, 0.0)), 15.0, [half])
    assert count == 1
    assert closed.areas[closed.centers[:, 0] < 0].sum() == pytest.approx(8.0 * 16.0)
    assert closed.areas[closed.centers[:, 0] > 0].sum() < 8.0 * 16.0 - 4.0


def test_holes_that_meet_in_a_vertex_are_closed_each():
    """Two squares of 1 mm, diagonally beside each other."""
    x, y = WHOLE.centers[:, 0], WHOLE.centers[:, 1]
    holed = WHOLE.part(~((np.abs(x) < 1) & (np.abs(y) < 1) & (x * y > 0)))
    assert sorted(len(loop) for loop in loops(holed)) == [8, 8, 4 * 32]
    closed, count = close_holes(holed, 15.0, [view()])
    assert count == 2 and closed.areas.sum() == pytest.approx(WHOLE.areas.sum())


def test_the_border_of_a_small_part_is_no_hole():
    """Wall that would close it lies behind it, and no view sees that from its front."""
    both = joined(without(WHOLE, (0.0, 0.0), radius=3.0), plane(20.0, 1.0, 0.5))
    closed, count = close_holes(both, 10.0, [view()])
    assert count == 0 and np.array_equal(closed.triangles, both.triangles)


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


def test_smoothing_moves_with_the_mesh_and_scales_with_it():
    rough = noisy(folded(), 0.1)
    moved = replace(rough, vertices=rough.vertices * np.float32(3.0) + np.float32([5, -2, 7]))
    expected = smoothed(rough).vertices * 3.0 + [5, -2, 7]
    np.testing.assert_allclose(smoothed(moved).vertices, expected, atol=0.02)
    assert np.abs(smoothed(rough).vertices[:, :2]).max() > 19.9, "the border does not shrink"


def test_nothing_to_smooth():
    rough = noisy(folded(), 0.1)
    assert smoothed(rough, 0.0) is rough
    corner = rough.part(np.arange(len(rough)) == 0)
    assert smoothed(corner) is corner
