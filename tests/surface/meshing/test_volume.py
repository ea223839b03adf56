"""Fusion of exact depth, a wall and a sphere seen from within, and colours of points from the views that see them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.meshing.colors import best_colors
from coliags_plugin.surface.meshing.views import DepthView
from coliags_plugin.surface.meshing.volume import Volume, _in_order
from tests.scenes import camera_at


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


def test_places_of_few_views_are_left_out():
    camera, depth = turned(0.0), torch.full((90, 120), 20.0)
    right = depth * (torch.arange(120) >= 60)
    assert len(Volume([view_of(camera, torch.zeros_like(depth))], 0.5, 4.0).mesh(1, 0.0)) == 0
    volume = Volume([view_of(camera, depth), view_of(camera, right)], 0.5, 4.0)
    assert volume.mesh(1, 0.0).areas.sum() == pytest.approx(2 * volume.mesh(2, 0.0).areas.sum(), rel=0.1)
    assert len(volume.mesh(3, 0.0)) == 0


def test_places_of_little_support_are_left_out():
    camera, depth = turned(0.0), torch.full((90, 120), 20.0)
    quality = torch.where(torch.arange(120) >= 60, 1.0, 0.5).expand(90, 120)
    volume = Volume([view_of(camera, depth, quality)] * 2, 0.5, 4.0)
    whole, half = (volume.mesh(1, support).areas.sum() for support in (0.4, 1.0))
    assert whole == pytest.approx(2 * half, rel=0.1)
    assert len(volume.mesh(1, 2.5)) == 0


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


def test_places_on_which_views_disagree_are_left_out():
    """Distances of 0 and 0.75 truncations have a variance of 0.14, of 0.07 over the support of two views."""
    camera = turned(0.0)
    other = torch.where(torch.arange(120) >= 60, 20.0, 20.75).expand(90, 120)
    volume = Volume([view_of(camera, torch.full((90, 120), 20.0)), view_of(camera, other)], 0.5, 2.0)
    half, whole = (volume.mesh(1, 0.0, conflict).areas.sum() for conflict in (0.06, 0.08))
    assert whole == pytest.approx(2 * half, rel=0.1)


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


def looking(x: float, depth: torch.Tensor, quality: float, value: int) -> DepthView:
    """A view along z of one colour."""
    image = torch.full((40, 60, 3), value, dtype=torch.uint8)
    camera = camera_at(x, 0.0, 0.0, 60, 40)
    return DepthView(camera, depth, torch.full((40, 60), quality), lambda: image)


def test_the_better_view_counts_by_the_fourth_power_of_its_quality():
    depth = torch.full((40, 60), 20.0)
    views = [looking(0.0, depth, 1.0, 200), looking(0.5, depth, 0.5, 30)]
    assert (best_colors(np.array([[0.0, 0.0, 20.0]]), views) == round((200 + 30 / 16) / (1 + 1 / 16))).all()


def test_what_hides_a_point_does_not_colour_it():
    hidden, open_ = (
        looking(0.0, torch.full((40, 60), 10.0), 1.0, 200),
        looking(0.0, torch.full((40, 60), 20.0), 0.1, 30),
    )
    assert (best_colors(np.array([[0.0, 0.0, 20.0]]), [hidden, open_]) == 30).all()


def test_points_that_no_view_sees_take_the_nearest_colour():
    view = looking(0.0, torch.full((40, 60), 20.0), 1.0, 90)
    points = np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 30.0]])
    assert (best_colors(points, [view]) == 90).all()
    assert (best_colors(points[1:], [view]) == 0).all()


def test_samples_are_bilinear_at_pixel_centres():
    view = looking(0.0, torch.full((40, 60), 20.0), 1.0, 0)
    ramp = torch.arange(60, dtype=torch.uint8)[None, :, None].expand(40, 60, 3) * 4
    at = torch.tensor([[20.5, 10.5], [21.0, 10.5]], dtype=torch.float64)
    camera = view.camera
    rays = torch.stack([(at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy, torch.ones(2)], dim=1)
    points = (camera.center + 20.0 * rays.double() @ camera.camera_to_world[:3, :3].T.double()).numpy()
    assert best_colors(points, [replace(view, image=lambda: ramp)])[:, 0].tolist() == [80, 82]
