"""Sharpness and motion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from coliags_plugin.pipeline.frame_measures import motion, reduced, sharpness
from tests.pipeline.films import WIDTH, blurred, film


def test_blur_lowers_sharpness():
    image = film([0])[0]
    values = [sharpness(reduced(image if sigma == 0 else blurred(image, sigma))) for sigma in (0, 1, 2, 4)]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.3 * values[0]


def test_brightness_does_not_change_sharpness():
    gray = reduced(film([0])[0])
    assert sharpness(gray // 2) == pytest.approx(sharpness(gray), rel=0.03)
    assert sharpness(np.zeros((40, 60), np.uint8)) == 0.0
    assert sharpness(np.full((40, 60), 100, np.uint8)) == 0.0


def test_highlights_do_not_make_a_blurred_frame_sharp():
    image = blurred(film([0])[0])
    before = sharpness(reduced(image))
    image[50:54, 60:66] = 255
    assert sharpness(reduced(image)) == pytest.approx(before, rel=0.05)


def test_large_frames_are_reduced():
    assert reduced(np.zeros((1080, 1350, 3), np.uint8)).shape == (384, 480)


@pytest.mark.parametrize("shift", [0, 1, 3, 8])
def test_motion_is_the_shift(shift):
    before, after = (reduced(frame) for frame in film([20, 20 + shift]))
    assert motion(before, after) * WIDTH == pytest.approx(shift, abs=0.1)


def test_motion_under_a_brighter_lamp():
    before, after = (reduced(frame) for frame in film([20, 22]))
    assert motion(before, cv2.convertScaleAbs(after, alpha=0.7)) * WIDTH == pytest.approx(2, abs=0.3)


def test_motion_of_another_scene_or_of_none_is_unknown():
    one, other = reduced(film([0])[0]), reduced(film([0], seed=1)[0])
    assert motion(one, other) > 0.02
    assert motion(np.full((100, 100), 80, np.uint8), one[:100, :100]) == float("inf")
