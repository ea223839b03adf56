"""A known point lies on the same pixel in every format, whatever its files count pixels from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from coliags_plugin.config.registry import phantom_layouts
from tests.phantom.phantom_layouts import in_video_order, read, write_phantom

FORMAT_OF = {"c3vd-raw": "c3vd", "endogslam": "c3vd-endogslam", "pr-endo": "c3vd-endogslam"}
WIDTH, HEIGHT = 66, 52
#: Camera axes, mm.
POINT = (4.0, -3.0, 20.0)


@pytest.mark.parametrize("layout", phantom_layouts)
def test_a_point_is_read_where_it_was_written(layout, tmp_path):
    folder = write_phantom(tmp_path / "colon", layout, WIDTH, HEIGHT, mesh_spacing=3.0, texture_spacing=1.0)
    scene = read(folder / ("C3VD/phantom" if layout == "pr-endo" else "."), FORMAT_OF.get(layout, layout))
    camera = in_video_order(scene)[3].camera
    lens, _ = phantom_layouts.get(layout)().lens(WIDTH, HEIGHT)
    # The lens counts pixel centres at integers, the scene's camera at integers + 0.5. Images that a lens bends are
    # undistorted to its nominal pinhole.
    k, (x, y, z) = lens.pinhole, POINT
    wanted = (k.fx * x / z + k.cx + 0.5, k.fy * y / z + k.cy + 0.5)
    world = camera.center + torch.tensor([POINT]) @ camera.camera_to_world[:3, :3].T
    pixel, _ = camera.project(world)
    np.testing.assert_allclose(pixel[0].numpy(), wanted, atol=2e-3)
