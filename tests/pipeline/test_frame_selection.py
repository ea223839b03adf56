"""Sharpness, motion, choice of sharp frames, and masks of lenses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.core.arrays import dilated
from coliags_plugin.pipeline.frame_selection import (
    EMPTY,
    THINNED,
    blurred_frames,
    corner_motion,
    lens_mask,
    overlays,
    reduced,
    sharpest_frames,
)
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.reconstruction.structure.texture import sharpness
from tests.pipeline.films import WIDTH, blurred, film

SHARPNESS = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60)


def test_the_sharpest_of_every_few_is_used():
    kept, dropped = sharpest_frames([0.5, 0.9, 0.6, 0.8, 0.7, 0.75, 0.6], FrameSettings(every=3))
    assert kept == [1, 3, 6]
    assert dropped == dict.fromkeys([0, 2, 4, 5], THINNED)


def test_the_sharpest_of_every_stretch_of_time_is_used():
    times = np.array([0.0, 0.04, 0.08, 0.12, 1.0, 1.3, 1.7])
    values, settings = [0.5, 0.9, 0.6, 0.8, 0.7, 0.75, 0.6], FrameSettings(every=2, per_second=2.0)
    assert sharpest_frames(values, settings, times)[0] == [1, 5, 6]
    assert sharpest_frames(values, settings)[0] == [1, 3, 5, 6]


def test_empty_frames_are_dropped_and_blurred_ones_marked():
    values = [0.5] * 20
    values[4], values[5], values[9] = 0.1, 0.2, 0.0
    kept, dropped = sharpest_frames(values, FrameSettings())
    assert dropped == {9: EMPTY}
    assert kept == [index for index in range(20) if index != 9]
    assert blurred_frames(kept, values, FrameSettings()) == {4, 5}
    assert not blurred_frames(kept, values, FrameSettings(least_sharpness=0.0))


def test_sharpness_is_compared_with_neighbours_as_the_view_changes():
    values = [1.0] * 60 + [0.2] * 60  # a textured, then a smooth part of the wall
    blurred = blurred_frames(range(120), values, FrameSettings())
    assert len(blurred) < 12
    assert blurred <= set(range(60, 70))


@given(SHARPNESS, st.integers(1, 30))
def test_every_frame_is_kept_or_dropped_and_one_of_every_few_is_kept(values, every):
    kept, dropped = sharpest_frames(values, FrameSettings(every=every))
    assert sorted([*kept, *dropped]) == list(range(len(values)))
    assert kept == sorted(kept)
    assert len(kept) <= -(-len(values) // every)


def test_the_mask_of_a_round_lens():
    rows, columns = np.mgrid[:120, :160]
    inside = (rows - 60) ** 2 + (columns - 80) ** 2 < 58**2
    image = np.where(inside, 90, 5).astype(np.uint8)
    image[50:70, 70:90] = 3  # the lumen is dark, and no border
    mask = lens_mask(image)
    assert not mask[~inside].any()
    assert mask[(rows - 60) ** 2 + (columns - 80) ** 2 < 53**2].all()
    for level in (90, 2):  # that of a full image, and of a black video
        assert lens_mask(np.full((120, 160), level, np.uint8)) is None


def survey(frames) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    stack = np.stack(frames)
    return stack.min(axis=0), stack.max(axis=0), stack.mean(axis=0, dtype=np.float32)


def titled(image: np.ndarray) -> np.ndarray:
    written = image.copy()
    cv2.putText(written, "NAME 12:34", (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (250, 250, 250), 1, cv2.LINE_AA)
    written[90:110, 120:150] = (20, 120, 200)
    return written


def test_overlays_are_found_where_the_rest_moves():
    plain = film(range(0, 150, 5))
    found = overlays(*survey([titled(image) for image in plain]))
    written = (titled(np.zeros_like(plain[0])) > 0).any(axis=2)
    assert found[written].all()
    assert not found[~dilated(written, 8)].any()
    assert not overlays(*survey(plain)).any()


def test_a_camera_that_rests_shows_no_overlays():
    assert not overlays(*survey([titled(film([0])[0])] * 9)).any()
    assert not overlays(*survey([titled(image) for image in film([0, 1, 0, 1])])).any()


def test_blur_lowers_sharpness():
    assert reduced(np.zeros((1080, 1350, 3), np.uint8)).shape == (384, 480)
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


@pytest.mark.parametrize("shift", [0, 1, 3, 8])
def test_motion_is_the_shift(shift):
    before, after = (reduced(frame) for frame in film([20, 20 + shift]))
    assert corner_motion(before, after)[0] * WIDTH == pytest.approx(shift, abs=0.1)


def test_motion_under_a_brighter_lamp():
    before, after = (reduced(frame) for frame in film([20, 22]))
    assert corner_motion(before, cv2.convertScaleAbs(after, alpha=0.7))[0] * WIDTH == pytest.approx(2, abs=0.3)


def test_motion_of_another_scene_or_of_none_is_unknown():
    one, other = reduced(film([0])[0]), reduced(film([0], seed=1)[0])
    assert corner_motion(one, other)[0] > 0.02
    assert corner_motion(np.full((100, 100), 80, np.uint8), one[:100, :100])[0] == float("inf")
