"""Residual of a rigid motion against the number of frames apart."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from coliags_plugin.reconstruction.structure import adjustment
from coliags_plugin.reconstruction.structure.adjustment import rigid_frames, rigidity
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


@pytest.mark.parametrize(
    ("residuals", "frames"),
    [
        ({}, None),
        ({1: 0.4, 2: 0.8, 4: 1.0, 8: 1.19}, None),
        # 1.2 px, three times that of neighbours, are reached at 10 frames, which lie on either side of the middle one.
        ({1: 0.4, 4: 0.9, 8: 1.0, 12: 1.4, 16: 1.0}, 21),
        ({1: 0.1, 4: 0.3, 8: 0.69}, None),  # below 0.7 px, 0.007 of the focal length, whatever neighbours have
        ({2: 0.1, 4: 0.6, 8: 0.8}, 13),
        ({2: 2.0, 4: 9.0}, 7),
    ],
)
def test_a_model_is_as_long_as_what_it_shows_is_rigid(residuals, frames, monkeypatch):
    monkeypatch.setattr(adjustment, "rigidity", lambda model, tracks: residuals)
    camera = pycolmap.Camera(model="PINHOLE", width=160, height=128, params=[100.0, 100.0, 80.0, 64.0])
    assert rigid_frames(SimpleNamespace(cameras={1: camera}), ()) == frames
