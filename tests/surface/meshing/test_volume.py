"""Fusion of exact depth, colours of points from the views that see them, and mending: holes, and smoothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.geometry.meshes.truth import angles_between
from coliags_plugin.surface.meshing.views import DepthView, best_colors
from coliags_plugin.surface.meshing.volume import Volume, _in_order, close_holes, loops, smoothed
from tests.scenes import camera_at
from tests.surface.coverage.tubes import joined, plane


def sphere_depth(camera: Camera, radius: float) -> torch.Tensor:
    """z-depth of a sphere around the origin, seen from within."""
    rays, center = camera.rays(), camera.center
    a, b, c = (rays * rays).sum(-1), (rays * center).sum(-1), center @ center - radius**2
    return (-b + (b * b - a * c).sqrt()) / a


def turned(angle: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    return Camera(80.0, 70.0, 63.0, 40.0, 120, 90, pose)


def view_of(camera: Camera, depth: torch.Tensor, quality: float | torch.Tensor = 1.0) -> DepthView:
    return DepthView(camera, depth.float(), torch.where(depth > 0, quality, 0.0).float(), lambda: None)


def test_a_sphere_is_where_it_is():
    cameras = [turned(2 * math.pi * step / 12) for step in range(12)]
    mesh = Volume([view_of(camera, sphere_depth(camera, 20.0)) for camera in cameras], 0.5, 3.0).mesh(1, 0.0)
    distance = np.linalg.norm(mesh.vertices, axis=1) - 20.0
    assert abs(distance.mean()) < 0.01
    assert np.abs(distance).max() < 0.1
    # Counter-clockwise seen from within: normals point to the centre.
    assert ((mesh.normals * mesh.centers).sum(1) < 0).mean() > 0.999


def test_pixel_centres():
    """Half a pixel of shift would move this oblique wall, z + 0.3 x = 20, by 0.035."""
    camera = turned(0.0)
    x = (torch.arange(120) + 0.5 - camera.cx) / camera.fx
    mesh = Volume([view_of(camera, (20.0 / (1.0 + 0.3 * x)).expand(90, 120))], 0.5, 4.0).mesh(1, 0.0)
    local = (mesh.vertices - camera.center.numpy()) @ camera.camera_to_world[:3, :3].numpy()
    assert abs((local[:, 2] + 0.3 * local[:, 0]).mean() - 20.0) < 0.015


RIGHT = torch.arange(120) >= 60


@pytest.mark.parametrize(
    ("views", "whole", "half", "none"),
    [
        ([(20.0, 1.0), (20.0 * RIGHT, 1.0)], (1, 0.0), (2, 0.0), (3, 0.0)),
        ([(20.0, torch.where(RIGHT, 1.0, 0.5).expand(90, 120))] * 2, (1, 0.4), (1, 1.0), (1, 2.5)),
        # Distances of 0 and 0.75 truncations have a variance of 0.14, of 0.07 over the support of two views.
        ([(20.0, 1.0), (torch.where(RIGHT, 20.0, 20.75), 1.0)], (1, 0.0, 0.08), (1, 0.0, 0.06), (3, 0.0, 0.08)),
    ],
    ids=["few views", "little support", "views that disagree"],
)
def test_places_on_which_too_few_views_agree_are_left_out(views, whole, half, none):
    camera = turned(0.0)
    volume = Volume([view_of(camera, torch.ones(90, 120) * depth, quality) for depth, quality in views], 0.5, 2.0)
    assert volume.mesh(*whole).areas.sum() == pytest.approx(2 * volume.mesh(*half).areas.sum(), rel=0.1)
    assert len(volume.mesh(*none)) == 0


def test_without_depth_there_is_no_surface():
    assert len(Volume([view_of(turned(0.0), torch.zeros(90, 120))], 0.5, 4.0).mesh(1, 0.0)) == 0


def test_of_two_views_the_better_counts_more():
    """A mean weighted by the fourth power of the quality, the distances of both being within the truncation."""
    camera = turned(0.0)
    pair = [view_of(camera, torch.full((90, 120), z), quality) for z, quality in ((20.0, 1.0), (20.4, 0.5))]
    mesh = Volume(pair, 0.5, 4.0).mesh(1, 0.0)
    assert camera.project(torch.from_numpy(mesh.vertices).double())[1].mean() == pytest.approx(20 + 0.4 / 17, abs=1e-3)


def test_views_clear_the_space_before_what_they_see():
    """A wall that one poor view claims in the midst of the space that others see through."""
    camera = turned(0.0)
    claimed = view_of(camera, torch.full((90, 120), 10.0), 0.3)
    real = [view_of(camera, torch.full((90, 120), 20.0))] * 2
    z = camera.project(torch.from_numpy(Volume([claimed, *real], 0.5, 3.0).mesh(1, 0.0).vertices).double())[1]
    assert z.min() > 19.9


def test_voxels_too_small_for_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr("coliags_plugin.surface.meshing.volume._MAX_BLOCKS", 1000)
    with pytest.raises(InputError, match=r"larger voxels\. Try `voxel=0.2"):
        Volume([view_of(turned(0.0), torch.full((90, 120), 20.0))], 0.1, 4.0)


def test_a_mesh_does_not_depend_on_the_order_in_which_its_parts_are_found():
    generator = np.random.default_rng(0)
    vertices = generator.integers(0, 4, (40, 3)).astype(np.float32)  # some are equal
    triangles = generator.integers(0, 40, (60, 3))
    triangles = triangles[TriangleMesh(vertices, triangles).areas > 0.0]
    first = _in_order(vertices, triangles)
    new = generator.permutation(40)  # place of each vertex
    turned = np.stack([np.roll(row, generator.integers(3)) for row in new[triangles]])
    second = _in_order(vertices[np.argsort(new)], generator.permutation(turned))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.triangles, second.triangles)
    assert len(np.unique(first.vertices, axis=0)) == len(first.vertices)


def looking(x: float, depth: float, quality: float, value: int) -> DepthView:
    """A view along z of a wall of one colour."""
    image = torch.full((40, 60, 3), value, dtype=torch.uint8)
    camera = camera_at(x, 0.0, 0.0, 60, 40)
    return DepthView(camera, torch.full((40, 60), depth), torch.full((40, 60), quality), lambda: image)


def test_the_better_view_counts_by_the_fourth_power_of_its_quality_and_none_where_it_is_hidden():
    points, sides = np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 30.0]]), ((0.0, 20.0, 1.0, 200), (0.5, 20.0, 0.5, 30))
    assert (best_colors(points[:1], [looking(*side) for side in sides]) == round((200 + 30 / 16) / (1 + 1 / 16))).all()
    assert (best_colors(points[:1], [looking(0.0, 10.0, 1.0, 200), looking(0.0, 20.0, 0.1, 30)]) == 30).all()
    assert (best_colors(points, [looking(0.0, 20.0, 1.0, 90)]) == 90).all(), "what no view sees takes the nearest"
    assert (best_colors(points[1:], [looking(0.0, 20.0, 1.0, 90)]) == 0).all()


def test_samples_are_bilinear_at_pixel_centres():
    view = looking(0.0, 20.0, 1.0, 0)
    ramp = torch.arange(60, dtype=torch.uint8)[None, :, None].expand(40, 60, 3) * 4
    at = torch.tensor([[20.5, 10.5], [21.0, 10.5]], dtype=torch.float64)
    camera = view.camera
    rays = torch.stack([(at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy, torch.ones(2)], dim=1)
    points = (camera.center + 20.0 * rays.double() @ camera.camera_to_world[:3, :3].T.double()).numpy()
    assert best_colors(points, [replace(view, image=lambda: ramp)])[:, 0].tolist() == [80, 82]


WHOLE = plane(20.0, 8.0, 0.5)


def without(mesh: TriangleMesh, *centers: tuple[float, float], radius: float = 1.4) -> TriangleMesh:
    """The mesh with holes about such x and y."""
    apart = [np.linalg.norm(mesh.centers[:, :2] - center, axis=1) > radius for center in centers]
    return mesh.part(np.all(apart, axis=0))


def view(depth: float = 20.0) -> DepthView:
    """A view along z from the origin, of a wall at such a depth."""
    return looking(0.0, depth, 1.0, 0)


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
