"""Gaussians of a view, and of none in particular."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from coliags_plugin.export.baking.baking import mean_gaussians
from coliags_plugin.export.viewer.content import VIEWS, spread
from coliags_plugin.export.viewer.splats import MARGIN, ViewDecoder, in_view, shown, widened
from tests.export.viewer.made import Scripted, some_gaussians
from tests.scenes import camera_at

CAMERA = camera_at(0.0, 0.0, -12.0)


def test_gaussians_of_no_view_are_means_weighted_by_opacity():
    one = some_gaussians(4)
    slots = torch.tensor([5, 0, 9, 2])
    first = replace(one, source_index=slots, opacities=torch.tensor([0.2, 0.4, 0.6, 0.8]))
    changed = {"colors": 1.0 - one.colors, "scales": 2.0 * one.scales, "quats_wxyz": -one.quats_wxyz}
    second = replace(first, opacities=torch.tensor([0.6, 0.1, 0.1, 0.1]), **changed)
    mean = mean_gaussians(Scripted(first, second), [CAMERA] * 2)
    assert mean.source_index.tolist() == [0, 2, 5, 9]
    row, weights = 2, torch.tensor([[0.2], [0.6]]) / 0.8  # slot 5, the first of both
    torch.testing.assert_close(mean.colors[row], weights[0] * first.colors[0] + weights[1] * second.colors[0])
    torch.testing.assert_close(mean.opacities[row], torch.tensor((0.2**2 + 0.6**2) / 0.8))
    torch.testing.assert_close(mean.scales[row], first.scales[0] * 2.0**0.75)
    turned = (mean.quats_wxyz[row] @ torch.nn.functional.normalize(one.quats_wxyz[0], dim=0)).abs()
    torch.testing.assert_close(turned, torch.tensor(1.0))


def test_views_that_see_nothing_change_nothing():
    some, nothing = some_gaussians(3, scales=2), some_gaussians(0, scales=2)
    mean = mean_gaussians(Scripted(nothing, some, nothing), [CAMERA] * 3)
    torch.testing.assert_close(mean.means, some.means)
    torch.testing.assert_close(mean.scales, some.scales)
    assert len(mean_gaussians(Scripted(nothing), [CAMERA])) == 0


def test_cameras_to_decode_from_are_spread_over_all():
    cameras = [camera_at(float(index), 0.0, 0.0) for index in range(100)]
    chosen = spread(cameras)
    assert len(chosen) == VIEWS and chosen[0] is cameras[0]
    steps = np.diff([float(camera.center[0]) for camera in chosen])
    assert set(steps) <= {6.0, 7.0}
    assert spread(cameras[:5]) == cameras[:5]


def test_in_view_is_what_projects_into_the_image():
    points = torch.as_tensor(np.random.default_rng(0).uniform(-30, 30, (2000, 3)))
    pixels, depth = CAMERA.project(points)
    inside = (depth > 0) & (pixels[:, 0] >= 0) & (pixels[:, 0] < 32) & (pixels[:, 1] >= 0) & (pixels[:, 1] < 24)
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(in_view(points.numpy(), CAMERA), inside.numpy())


def test_a_view_shows_what_is_decoded_for_it_and_the_baked_beside_it():
    everywhere = shown(some_gaussians(500))
    seen = some_gaussians(7, seed=1)
    field = Scripted(seen)
    drawn = ViewDecoder(field, everywhere, torch.device("cpu")).of(CAMERA)
    beside = ~in_view(everywhere.means, widened(CAMERA))
    assert 0 < beside.sum() < 500
    np.testing.assert_array_equal(drawn.means[:7], seen.means.numpy())
    np.testing.assert_array_equal(drawn.means[7:], everywhere.means[beside])
    wide = field.cameras[0]
    assert CAMERA.fx / wide.fx == CAMERA.fy / wide.fy == MARGIN
    assert (wide.width, wide.height, wide.cx) == (CAMERA.width, CAMERA.height, CAMERA.cx)
