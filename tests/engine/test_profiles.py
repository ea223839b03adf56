"""Profiles of errors over distance and angle, against closed forms."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.scoring import ANGLE_EDGES, DISTANCE_EDGES, ErrorProfiles
from tests.scenes import camera_at


def pose(yaw=0.3):
    return camera_at(1.0, 2.0, 3.0, yaw=yaw).camera_to_world


def view(camera, depth, rgb_error=0.1, depth_error=2.0, mask=None, depth_valid=None):
    """A frame of this true depth and its rendering with these errors."""
    image = torch.full((camera.height, camera.width, 3), 100, dtype=torch.uint8)
    frame = Frame.of("f", 0, image, camera, depth, mask)
    is_known = torch.isfinite(depth) if depth_valid is None else depth_valid
    compared = Comparison(
        frame.rgb + rgb_error, frame.rgb, frame.valid, depth + depth_error, depth, is_known & frame.valid
    )
    return compared, frame


def profiles(*views, unit="mm"):
    records = ErrorProfiles(unit)
    for compared, frame in views:
        records.add(compared, frame)
    return records.records()


def pixel(column, row, camera):
    """The bin indices of one pixel's distance per z-depth and angle, by trigonometry."""
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    return math.sqrt(1 + x * x + y * y), math.degrees(math.acos(1 / math.sqrt(1 + x * x + y * y)))


def test_a_distance_on_an_edge_belongs_to_the_bin_above():
    camera = Camera(10.0, 10.0, 0.5, 0.5, 1, 1, pose())
    for edge, z in enumerate(DISTANCE_EDGES[1:-1], start=1):
        assert profiles(view(camera, torch.tensor([[z]])))["distance"].pixels[edge] == 1


def test_pixels_and_errors_are_in_the_bins_where_trigonometry_puts_them():
    """Colour error grows with the angle and depth error with the distance: each bin has the mean over its pixels."""
    camera = Camera(20.0, 17.0, 15.0, 12.5, 32, 24, pose())
    rays = np.array([[pixel(column, row, camera) for column in range(32)] for row in range(24)])
    depth = torch.rand(24, 32, generator=torch.Generator().manual_seed(0)) * 90 + 1
    rgb_error, depth_error = rays[..., 1] / 1000, rays[..., 0]
    compared = view(camera, depth, torch.from_numpy(rgb_error)[..., None], torch.from_numpy(depth_error))
    records = profiles(compared)
    assert (records["distance"].unit, records["angle"].unit) == ("mm", "degrees")
    assert profiles(compared, unit="units")["distance"].unit == "units"
    bins = {"distance": (rays[..., 0] * depth.numpy(), DISTANCE_EDGES), "angle": (rays[..., 1], ANGLE_EDGES)}
    for name, (where, edges) in bins.items():
        assert records[name].edges == edges and sum(records[name].pixels) == 24 * 32
        for index, (low, high) in enumerate(pairwise(edges)):
            inside = (where >= low) & (where < high)
            assert records[name].pixels[index] == inside.sum()
            for errors, means in ((rgb_error, records[name].rgb_mse), (depth_error, records[name].depth_mse)):
                mean = pytest.approx((errors[inside] ** 2).mean(), rel=1e-4) if inside.any() else None
                assert means[index] == mean


def test_the_mean_is_over_the_pixels_of_all_frames_and_channels():
    camera, wide = Camera(10.0, 10.0, 0.5, 0.5, 1, 1, pose()), Camera(1e3, 1e3, 1.0, 0.5, 2, 1, pose(1.0))
    first = view(camera, torch.tensor([[12.0]]), rgb_error=torch.tensor([0.3, 0.0, 0.0]), depth_error=3.0)
    second = view(wide, torch.tensor([[12.0, 13.0]]), rgb_error=0.0, depth_error=0.0)
    records = profiles(first, second)["distance"]
    assert records.pixels[2] == 3
    assert records.depth_mse[2] == 3.0
    assert records.rgb_mse[2] == pytest.approx(0.09 / 3 / 3, rel=1e-5)


def test_only_pixels_of_known_depth_that_are_compared_count():
    camera = Camera(1e3, 1e3, 2.0, 0.5, 4, 1, pose())
    depth = torch.tensor([[12.0, torch.nan, 12.0, 400.0]])
    compared = view(camera, depth, mask=torch.tensor([[True, True, False, True]]))
    assert sum(profiles(compared)["distance"].pixels) == 1, "one is masked, one unknown, and one beyond the last edge"
    everywhere = view(camera, depth, depth_valid=torch.ones(1, 4, dtype=torch.bool))
    assert sum(profiles(everywhere)["distance"].pixels) == 2, "a protocol that compares unknown depth has no distance"


def test_a_depth_that_is_not_finite_leaves_its_bin_without_a_value():
    camera = Camera(1e3, 1e3, 1.0, 0.5, 2, 1, pose())
    records = profiles(view(camera, torch.tensor([[12.0, 12.0]]), depth_error=torch.tensor([[torch.inf, 1.0]])))
    assert records["distance"].pixels[2] == 2 and records["distance"].depth_mse[2] is None
    assert records["distance"].rgb_mse[2] is not None


def test_without_true_depth_there_is_no_profile():
    frame = Frame.of("f", 0, torch.zeros(1, 1, 3, dtype=torch.uint8), Camera(10.0, 10.0, 0.5, 0.5, 1, 1, pose()))
    assert profiles((Comparison(frame.rgb, frame.rgb, frame.valid), frame)) == profiles() == {}
