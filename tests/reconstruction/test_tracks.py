"""Points and where they were seen: closed forms of two views."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.reconstruction.structure.tracks import LEAST_NOISE, Tracks, uncertainty, widest_angles

F, DEPTH, BASELINE = 120.0, 30.0, 4.0


def camera(x):
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[0, 3] = x
    return Camera(F, F, 50.0, 40.0, 100, 80, c2w)


CAMERAS = [camera(-BASELINE / 2), camera(BASELINE / 2)]


def tracks(points, shift=0.0):
    """Seen by both cameras, the second ``shift`` pixels to the side of where it should."""
    points = np.asarray(points, np.float64)
    pixels = [cam.project(torch.from_numpy(points))[0].numpy() for cam in CAMERAS]
    pixels[1] = pixels[1] + [shift, 0.0]
    numbers = np.arange(len(points))
    return Tracks(points, np.tile(numbers, 2), np.repeat([0, 1], len(points)), np.concatenate(pixels))


def test_what_points_leave_over():
    residuals, depth = tracks([[1.0, 2, DEPTH], [0, 0, 50]], shift=0.5).residuals(CAMERAS)
    np.testing.assert_allclose(residuals, [[0, 0], [0, 0], [-0.5, 0], [-0.5, 0]], atol=1e-12)
    np.testing.assert_allclose(depth, [DEPTH, 50, DEPTH, 50])


def test_the_angle_between_two_rays():
    expected = np.degrees(2 * np.arctan(BASELINE / 2 / DEPTH))
    assert widest_angles(tracks([[0.0, 0, DEPTH]]), CAMERAS) == pytest.approx(expected)


def test_depth_is_as_uncertain_as_the_parallax_is_small():
    """Between two cameras: sigma_z / z = sqrt(2) sigma z / (f b)."""
    noise, shares = uncertainty(tracks([[0.0, 0, DEPTH], [0, 0, 2 * DEPTH]]), CAMERAS)
    assert noise == LEAST_NOISE
    np.testing.assert_allclose(shares, np.sqrt(2) * noise * DEPTH / (F * BASELINE) * np.array([1, 2]), rtol=1e-6)


def test_residuals_tell_the_noise():
    """8 residuals, 2 of them 0.5 px, for 6 numbers that were fitted."""
    noise, shares = uncertainty(tracks([[0.0, 0, DEPTH], [3, 1, DEPTH]], shift=0.5), CAMERAS)
    assert noise == pytest.approx(np.sqrt(2 * 0.25 / 2))
    assert shares[0] == pytest.approx(np.sqrt(2) * noise * DEPTH / (F * BASELINE))


def test_parallel_rays_have_no_depth():
    far = tracks([[0.0, 0, 1e7]])
    assert uncertainty(far, CAMERAS)[1][0] > 100.0


def test_some_of_the_points():
    some = tracks([[0.0, 0, 10], [0, 1, 20], [0, 2, 30]]).only(np.array([True, False, True]))
    assert len(some) == 2
    np.testing.assert_array_equal(some.points, [0, 1, 0, 1])
    np.testing.assert_array_equal(some.frames, [0, 0, 1, 1])
    np.testing.assert_array_equal(some.lengths, [2, 2])
    np.testing.assert_allclose(some.residuals(CAMERAS)[1], [10, 30, 10, 30])
    assert len(some.only(np.array([False, False]))) == 0
    assert uncertainty(some.only(np.array([False, False])), CAMERAS)[1].shape == (0,)
