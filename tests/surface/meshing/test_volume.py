"""Fusion of exact depth: a wall and a sphere seen from within, where the mesh must lie."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.surface.meshing.fusion import Volume
from tests.scenes import wall_scene


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


def test_a_sphere_is_where_it_is():
    volume = Volume(0.5, 4.0)
    colors = np.full((90, 120, 3), (200, 100, 50), np.uint8)
    for step in range(12):
        camera = turned(2 * math.pi * step / 12)
        volume.add(sphere_depth(camera, 20.0).float().numpy(), colors, camera)
    mesh = volume.mesh(1)
    distance = np.linalg.norm(mesh.vertices, axis=1) - 20.0
    assert abs(distance.mean()) < 0.02
    assert np.abs(distance).max() < 0.25
    # Counter-clockwise seen from within: normals point to the centre.
    assert ((mesh.normals * mesh.centers).sum(1) < 0).mean() > 0.999
    assert np.abs(mesh.colors.astype(int) - (200, 100, 50)).max() <= 1


def test_pixel_centres():
    """Half a pixel of shift would move an oblique wall by several tenths of a millimetre."""
    volume = Volume(0.4, 4.0)
    for frame in wall_scene(frames=9, width=160, height=120).train:
        volume.add(frame.depth.numpy(), frame.image.numpy(), frame.camera)
    mesh = volume.mesh(3)
    assert np.abs(mesh.vertices[:, 2] - 20.0).max() < 0.01


def test_places_of_few_views_are_left_out():
    volume, camera, black = Volume(0.5, 4.0), turned(0.0), np.zeros((90, 120, 3), np.uint8)
    depth = np.full((90, 120), 20.0, np.float32)
    volume.add(np.zeros_like(depth), black, camera)
    assert len(volume.mesh(1)) == 0
    volume.add(depth, black, camera)
    volume.add(depth * (np.arange(120) >= 60), black, camera)
    assert volume.mesh(1).areas.sum() == pytest.approx(2 * volume.mesh(2).areas.sum(), rel=0.1)
    assert len(volume.mesh(3)) == 0


def test_voxels_too_small_for_the_memory_are_refused(monkeypatch):
    monkeypatch.setattr("coliags_plugin.surface.meshing.fusion._MAX_BLOCKS", 1000)
    volume = Volume(0.1, 4.0)
    with pytest.raises(InputError, match=r"larger voxels\. Try --voxel 0.2"):
        volume.add(np.full((90, 120), 20.0, np.float32), np.zeros((90, 120, 3), np.uint8), turned(0.0))
