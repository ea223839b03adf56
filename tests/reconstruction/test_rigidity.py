"""Residual of a rigid motion against the number of frames apart."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.reconstruction.structure.rigidity import rigidity
from tests.reconstruction.seen_points import frame_points, seen_points


def measured(noise=0.0, speed=0.0):
    """Of points seen with noise, px, each moving through the image in a direction of its own, px a frame."""
    model, observed = seen_points()
    rng = np.random.default_rng(0)
    motion = speed * rng.normal(0.0, 1.0, (len(model.points3D) + 1, 2))
    tracks = []
    for index, points in enumerate(observed):
        moved = points.pixels + rng.normal(0.0, noise, points.pixels.shape) + index * motion[points.points]
        tracks.append(frame_points(points.points, moved))
    return rigidity(model, tracks)


def test_a_rigid_scene_is_one_to_the_noise():
    assert set(measured()) == {1, 2}  # farther apart too few points are common
    assert max(measured().values()) < 1e-3
    noisy = measured(noise=0.5)
    # Both ends of a track are noisy, and a part of the distance to the line is fitted: 0.67 times the deviation.
    assert noisy[1] == pytest.approx(0.34, rel=0.4)
    assert noisy[2] == pytest.approx(noisy[1], rel=0.5)


def test_a_moving_scene_is_farther_off_the_longer_it_moves():
    moving = measured(speed=1.0)
    assert moving[1] > 0.3
    assert moving[2] > 1.4 * moving[1]
