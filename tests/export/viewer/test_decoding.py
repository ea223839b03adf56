"""Gaussians of a view, and of none in particular."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from coliags_plugin.export.viewer.baking import VIEWS, bake, baking_cameras
from coliags_plugin.export.viewer.decoding import MARGIN, ViewDecoder, in_view, widened
from coliags_plugin.export.viewer.splats import Splats
from tests.export.viewer.made import Scripted, some_gaussians
from tests.scenes import camera_at

CAMERA = camera_at(0.0, 0.0, -12.0)


def test_baked_light_is_the_mean_over_the_views_that_drew_it():
    one = some_gaussians(4)
    slots = torch.tensor([5, 0, 9, 2])
    first = replace(one, source_index=slots, opacities=torch.tensor([0.2, 0.4, 0.6, 0.8]))
    second = replace(
        *(first,),
        opacities=torch.tensor([0.6, 0.1, 0.1, 0.1]),
        colors=1.0 - one.colors,
        scales=2.0 * one.scales,
    )
    third = replace(second, **{name: getattr(second, name)[:1] for name in ("means", "quats_wxyz", "scales")})
    third = replace(third, opacities=second.opacities[:1], colors=second.colors[:1], source_index=slots[:1])
    baked = bake(Scripted(first, second, third), [CAMERA] * 3)
    order = baked.source_index.argsort()
    assert baked.source_index[order].tolist() == [0, 2, 5, 9]
    place = baked.source_index.tolist().index(5)
    color = (0.2 * first.colors[0] + 1.2 * second.colors[0]) / 1.4
    torch.testing.assert_close(baked.colors[place], color)
    torch.testing.assert_close(baked.opacities[place], torch.tensor(1.4 / 3))
    torch.testing.assert_close(baked.scales[place], second.scales[0])  # most opaque there
    other = baked.source_index.tolist().index(0)
    torch.testing.assert_close(baked.opacities[other], torch.tensor(0.25))
    torch.testing.assert_close(baked.scales[other], first.scales[1])


def test_views_that_see_nothing_change_nothing():
    some, nothing = some_gaussians(3), some_gaussians(0)
    baked = bake(Scripted(nothing, some, nothing), [CAMERA] * 3)
    torch.testing.assert_close(baked.means, some.means)
    assert len(bake(Scripted(nothing), [CAMERA])) == 0


def test_cameras_to_bake_from_are_spread_over_all():
    cameras = [camera_at(float(index), 0.0, 0.0) for index in range(100)]
    chosen = baking_cameras(cameras)
    assert len(chosen) == VIEWS and chosen[0] is cameras[0]
    steps = np.diff([float(camera.center[0]) for camera in chosen])
    assert set(steps) <= {6.0, 7.0}
    assert baking_cameras(cameras[:5]) == cameras[:5]


def test_in_view_is_what_projects_into_the_image():
    points = torch.as_tensor(np.random.default_rng(0).uniform(-30, 30, (2000, 3)))
    pixels, depth = CAMERA.project(points)
    inside = (depth > 0) & (pixels[:, 0] >= 0) & (pixels[:, 0] < 32) & (pixels[:, 1] >= 0) & (pixels[:, 1] < 24)
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(in_view(points.numpy(), CAMERA), inside.numpy())


def test_the_widened_camera_sees_more_by_the_margin():
    wide = widened(CAMERA)
    assert CAMERA.fx / wide.fx == CAMERA.fy / wide.fy == MARGIN
    assert (wide.width, wide.height, wide.cx) == (CAMERA.width, CAMERA.height, CAMERA.cx)


def test_a_view_shows_what_is_decoded_for_it_and_the_baked_beside_it():
    everywhere = Splats.of(some_gaussians(500))
    seen = some_gaussians(7, seed=1)
    field = Scripted(seen)
    shown = ViewDecoder(field, everywhere, torch.device("cpu")).of(CAMERA)
    beside = ~in_view(everywhere.centers, widened(CAMERA))
    assert 0 < beside.sum() < 500
    np.testing.assert_array_equal(shown.centers[:7], seen.means.numpy())
    np.testing.assert_array_equal(shown.centers[7:], everywhere.centers[beside])
    assert field.cameras[0].fx == CAMERA.fx / MARGIN
