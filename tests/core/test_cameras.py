"""The camera's arithmetic."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes import camera_at


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-5, 5), y=st.floats(-5, 5), z=st.floats(-5, 5), yaw=st.floats(-3, 3), depth=st.floats(0.1, 100))
def test_unproject_then_project_is_the_pixel_centre(x, y, z, yaw, depth):
    camera = camera_at(x, y, z, yaw=yaw)
    points = camera.unproject(torch.full((24, 32), depth, dtype=torch.float64))
    pixels, found = camera.project(points.reshape(-1, 3))
    rows, columns = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    expected = torch.stack([columns, rows], -1).reshape(-1, 2).double() + 0.5
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(found, torch.full_like(found, depth), rtol=1e-9, atol=0)


def test_project_agrees_with_the_matrices():
    camera = camera_at(1.0, 2.0, 3.0, yaw=0.3)
    point = torch.tensor([2.0, 1.0, 15.0], dtype=torch.float64)
    local = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    homogeneous = camera.intrinsics_matrix @ local
    pixels, depth = camera.project(point[None])
    torch.testing.assert_close(pixels[0], homogeneous[:2] / homogeneous[2])
    torch.testing.assert_close(depth[0], local[2])


def test_resized_camera_sees_the_same():
    camera = camera_at(0.0, 0.0, 0.0)
    half = camera.resized(16, 12)
    point = torch.tensor([[1.0, -2.0, 10.0]], dtype=torch.float64)
    torch.testing.assert_close(half.project(point)[0] * 2, camera.project(point)[0])
