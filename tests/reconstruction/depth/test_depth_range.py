"""Depth range from features, sparse depth, or given."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.reconstruction.depth.depth_range import find_range, given_range
from coliags_plugin.reconstruction.structure.features import FeatureSettings
from tests.reconstruction.depth.walls import sideways, wall_depth, wall_frames

FEATURES = FeatureSettings(highlight_level=256)


def test_features_give_the_range_in_any_unit():
    frames = wall_frames(sideways(8))
    found = find_range(frames, FEATURES, 40.0)
    depths = [wall_depth(frame.camera) for frame in frames]
    assert 0.4 * min(map(np.min, depths)) < found.near < min(map(np.min, depths))
    assert max(map(np.max, depths)) < found.far < 3.0 * max(map(np.max, depths))
    np.testing.assert_allclose(found.medians, [np.median(depth) for depth in depths], rtol=0.08)
    scaled = []
    for frame in frames:
        pose = frame.camera.camera_to_world.clone()
        pose[:3, 3] *= 1e-3
        scaled.append(dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, camera_to_world=pose)))
    smaller = find_range(scaled, FEATURES, 40.0)
    assert smaller.near == pytest.approx(1e-3 * found.near, rel=1e-6)
    assert smaller.far == pytest.approx(1e-3 * found.far, rel=1e-6)


def test_sparse_depth_of_the_scene_counts():
    pixels = torch.full((50, 2), 20.5)
    depths = torch.linspace(30.0, 50.0, 50)
    frames = [
        dataclasses.replace(frame, sparse_depth=SparseDepth(pixels, depths)) for frame in wall_frames(sideways(4, 0.0))
    ]
    found = find_range(frames, FEATURES, 40.0)
    assert found.near == pytest.approx(0.6 * np.percentile(np.tile(depths, 4), 1.0), rel=1e-5)
    assert found.far == pytest.approx(2.0 * np.percentile(np.tile(depths, 4), 99.0), rel=1e-5)
    np.testing.assert_allclose(found.medians, 40.0, rtol=1e-5)


def test_a_given_range():
    assert given_range(10.0, 40.0, 2).medians == (20.0, 20.0)
    with pytest.raises(InputError, match="0 < near < far"):
        given_range(0.0, 40.0, 2)


def test_frames_without_features_are_refused():
    flat = torch.full((80, 96, 3), 90, dtype=torch.uint8)
    frames = [dataclasses.replace(frame, image=flat) for frame in wall_frames(sideways(4))]
    with pytest.raises(InputError, match="the depth range is unknown: 0 points"):
        find_range(frames, FEATURES, 40.0)
