"""The lens without distortion."""

from __future__ import annotations

import numpy as np

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.pinhole import PinholeLens

LENS = PinholeLens(fx=61.0, fy=55.0, cx=33.5, cy=21.5, width=64, height=48)


def test_pixels_and_directions_are_inverse():
    pixels = np.array([[33.5, 21.5], [0.5, 0.5], [63.75, -7.0]])
    directions = LENS.unproject(pixels)
    np.testing.assert_array_equal(directions[0], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(LENS.project(7.0 * directions), pixels, atol=1e-12)


def test_points_behind_the_camera_have_no_pixel():
    assert np.isnan(LENS.project([[1.0, 2.0, -3.0], [1.0, 2.0, 0.0]])).all()


def test_scaled_and_cropped_images_show_the_same():
    directions = LENS.unproject([[10.5, 12.5]])
    # Pixel 10 covers 10 to 11: at twice the size, 20 to 22.
    np.testing.assert_allclose(LENS.resized(128, 96).project(directions), [[21.0, 25.0]])
    np.testing.assert_allclose(LENS.cropped(4, 5, 20, 20).project(directions), [[6.5, 7.5]])
    assert (LENS.cropped(4, 5, 20, 22).width, LENS.cropped(4, 5, 20, 22).height) == (20, 22)


def test_it_is_the_pinhole_it_is_made_of():
    intrinsics = Intrinsics(61.0, 55.0, 33.5, 21.5, 64, 48)
    assert PinholeLens.of(intrinsics) == LENS
    assert LENS.pinhole == intrinsics
    assert isinstance(LENS.resized(32, 24), PinholeLens)
