"""Colours of points from the views that see them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch

from coliags_plugin.surface.meshing.colors import best_colors
from coliags_plugin.surface.meshing.views import DepthView
from tests.scenes import camera_at


def looking(x: float, depth: torch.Tensor, quality: float, value: int) -> DepthView:
    """A view along z of one colour."""
    image = torch.full((40, 60, 3), value, dtype=torch.uint8)
    camera = camera_at(x, 0.0, 0.0, 60, 40)
    return DepthView(SimpleNamespace(image=image), camera, depth, torch.full((40, 60), quality))


def image_of(view: DepthView) -> torch.Tensor:
    return view.frame.image


def test_the_better_view_counts_by_the_fourth_power_of_its_quality():
    depth = torch.full((40, 60), 20.0)
    views = [looking(0.0, depth, 1.0, 200), looking(0.5, depth, 0.5, 30)]
    assert (best_colors(np.array([[0.0, 0.0, 20.0]]), views, image_of) == round((200 + 30 / 16) / (1 + 1 / 16))).all()


def test_what_hides_a_point_does_not_colour_it():
    hidden, open_ = (
        looking(0.0, torch.full((40, 60), 10.0), 1.0, 200),
        looking(0.0, torch.full((40, 60), 20.0), 0.1, 30),
    )
    assert (best_colors(np.array([[0.0, 0.0, 20.0]]), [hidden, open_], image_of) == 30).all()


def test_points_that_no_view_sees_take_the_nearest_colour():
    view = looking(0.0, torch.full((40, 60), 20.0), 1.0, 90)
    points = np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 30.0]])
    assert (best_colors(points, [view], image_of) == 90).all()
    assert (best_colors(points[1:], [view], image_of) == 0).all()


def test_samples_are_bilinear_at_pixel_centres():
    view = looking(0.0, torch.full((40, 60), 20.0), 1.0, 0)
    ramp = torch.arange(60, dtype=torch.uint8)[None, :, None].expand(40, 60, 3) * 4
    at = torch.tensor([[20.5, 10.5], [21.0, 10.5]], dtype=torch.float64)
    camera = view.camera
    rays = torch.stack([(at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy, torch.ones(2)], dim=1)
    points = (camera.center + 20.0 * rays.double() @ camera.camera_to_world[:3, :3].T.double()).numpy()
    assert best_colors(points, [view], lambda _: ramp)[:, 0].tolist() == [80, 82]
