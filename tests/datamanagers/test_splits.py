"""Which frames are held out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.datamanagers.splits import held_out, split_options


@pytest.mark.parametrize(
    ("arguments", "test"),
    [
        (("every-8th", 25), [0, 8, 16, 24]),
        (("inner-8th", 21), [4, 12]),
        (("inner-8th", 22), [4, 12, 20]),
        (("endogslam", 25), [7, 15, 23]),
        (("block", 20), [8, 9, 10, 11]),
        (("block", 10, (0.0, 0.3)), [0, 1, 2]),
        (("all-train", 5), []),
    ],
)
def test_frames_that_are_held_out(arguments, test):
    assert np.flatnonzero(held_out(*arguments)).tolist() == test


@pytest.mark.parametrize(
    # docs/layouts/c3vd.md 6: frames and test frames of the official sequences
    ("frames", "test"),
    [(276, 35), (765, 96), (370, 47), (1142, 143), (595, 75), (730, 92), (61, 8), (194, 25), (103, 13), (597, 75)],
)
def test_counts_of_the_official_sequences(frames, test):
    assert held_out("every-8th", frames).sum() == test


@given(count=st.integers(1, 300), start=st.floats(0, 0.9), length=st.floats(0.05, 0.5))
def test_a_block_is_one_stretch_of_about_its_share(count, start, length):
    held = held_out("block", count, (start, min(start + length, 1.0)))
    assert (np.diff(np.flatnonzero(held)) == 1).all()
    assert abs(held.sum() - (min(start + length, 1.0) - start) * count) <= 1.0


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        (("every-8th",), []),
        (("inner-8th",), ["datamanager.split=inner-8th"]),
        (("block", (0.25, 0.5)), ["datamanager.split=block", "datamanager.block=[0.25, 0.5]"]),
    ],
)
def test_options_choose_a_split(arguments, options):
    assert split_options(*arguments) == options
