"""Held-out frames, in the official sequences too, and the unit of length that a scene states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scene_files import read_unit, write_unit
from coliags_plugin.core.splits import held_out, split_options


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


@given(count=st.integers(1, 300), start=st.floats(0, 0.9), length=st.floats(0.05, 0.5))
def test_a_block_is_one_stretch_of_about_its_share(count, start, length):
    is_test = held_out("block", count, (start, min(start + length, 1.0)))
    assert (np.diff(np.flatnonzero(is_test)) == 1).all()
    assert abs(is_test.sum() - (min(start + length, 1.0) - start) * count) <= 1.0


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


def test_a_stated_unit_is_read_back_and_else_that_of_the_format(tmp_path: Path) -> None:
    assert read_unit(tmp_path, otherwise="mm") == "mm"
    assert read_unit(tmp_path) == "unknown"
    for unit in ("mm", "cm", "m", "unknown"):
        write_unit(tmp_path, unit)  # type: ignore[arg-type]
        assert read_unit(tmp_path, otherwise="mm") == unit
    (tmp_path / "unit.txt").write_text("inches\n")
    with pytest.raises(InputError, match="inches"):
        read_unit(tmp_path)


# What the page says of C3VD's sequences, against the lists that its authors publish
