"""Choice of sharp frames, and masks of lenses."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.pipeline.frame_selection import BLURRED, EMPTY, THINNED, lens_mask, sharp_frames
from coliags_plugin.pipeline.settings import FrameSettings

SHARPNESS = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60)


def test_the_sharpest_of_every_few_is_used():
    kept, dropped = sharp_frames([0.5, 0.9, 0.6, 0.8, 0.7, 0.75, 0.6], FrameSettings(every=3))
    assert kept == [1, 3, 6]
    assert dropped == dict.fromkeys([0, 2, 4, 5], THINNED)


def test_blurred_and_empty_frames_are_dropped():
    values = [0.5] * 20
    values[4], values[5], values[9] = 0.1, 0.2, 0.0
    kept, dropped = sharp_frames(values, FrameSettings())
    assert dropped == {4: BLURRED, 5: BLURRED, 9: EMPTY}
    assert kept == [index for index in range(20) if index not in dropped]
    assert sharp_frames(values, FrameSettings(least_sharpness=0.0))[1] == {9: EMPTY}


def test_sharpness_is_compared_with_neighbours_as_the_view_changes():
    values = [1.0] * 60 + [0.2] * 60  # a textured, then a smooth part of the wall
    kept, dropped = sharp_frames(values, FrameSettings())
    assert len(kept) > 108
    assert set(dropped) <= set(range(60, 70))


@given(SHARPNESS, st.integers(2, 30))
def test_every_frame_is_kept_or_dropped_and_no_more_than_asked_for(sharpness, at_most):
    kept, dropped = sharp_frames(sharpness, FrameSettings(at_most=at_most))
    assert sorted([*kept, *dropped]) == list(range(len(sharpness)))
    assert kept == sorted(kept)
    assert len(kept) <= at_most


def test_the_mask_of_a_round_lens():
    rows, columns = np.mgrid[:120, :160]
    inside = (rows - 60) ** 2 + (columns - 80) ** 2 < 58**2
    image = np.where(inside, 90, 5).astype(np.uint8)
    image[50:70, 70:90] = 3  # the lumen is dark, and no border
    mask = lens_mask(image)
    assert not mask[~inside].any()
    assert mask[(rows - 60) ** 2 + (columns - 80) ** 2 < 53**2].all()


def test_a_full_image_needs_no_mask():
    assert lens_mask(np.full((120, 160), 90, np.uint8)) is None
    assert lens_mask(np.full((120, 160), 2, np.uint8)) is None  # a black video
