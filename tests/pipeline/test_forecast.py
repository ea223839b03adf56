"""What a reconstruction is expected to take, and settings that keep to a budget."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.pipeline.forecast import forecast, seconds_of, within_budget
from coliags_plugin.pipeline.settings import ReconstructionSettings


class Frames:
    """A source of as many frames as it says."""

    def __init__(self, expected):
        self.expected = expected

    def __iter__(self):
        yield "frame_000000", np.zeros((384, 384, 3), np.uint8)


def test_the_clip_that_it_was_measured_on():
    """247 frames: 2,400 s of processor time and 487 MB."""
    expected = forecast(Frames(247), ReconstructionSettings())
    assert expected.seconds == pytest.approx(2400.0, rel=0.2) and expected.size == pytest.approx(487e6, rel=0.3)
    assert "247 frames of use: about" in str(expected)


@given(st.integers(50, 40_000), st.floats(600.0, 1e6), st.integers(1, 64))
def test_a_budget_is_kept_with_as_much_as_it_allows(count, seconds, cores):
    wanted = ReconstructionSettings()
    try:
        chosen = within_budget(Frames(count), wanted, seconds, cores)
    except InputError as error:
        assert "Give a larger --budget" in str(error)
        return
    assert forecast(Frames(count), chosen).seconds <= seconds * cores
    if forecast(Frames(count), wanted).seconds <= seconds * cores:
        assert chosen == wanted
    assert chosen.model_copy(update={"steps": wanted.steps, "frames": wanted.frames}) == wanted


@pytest.mark.parametrize(("text", "seconds"), [("45s", 45.0), ("30min", 1800.0), ("2.5h", 9000.0)])
def test_times_with_units(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "30", "min", "-3h", "2 days", "nanh"])
def test_what_is_no_time(text):
    with pytest.raises(InputError, match="30min"):
        seconds_of(text)


def test_a_full_disk_is_told_before_anything_is_written(video, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    with pytest.raises(InputError, match=r"1 MB are free for .*out, and about \d+ MB needed"):
        cp.reconstruct(video, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_budget_reduces_steps_and_frames(done, video, tmp_path, monkeypatch):
    """Of 15 frames: a sub-map takes longer than this, whatever is left out."""
    with pytest.raises(InputError, match=r"a budget of 10.0 s, and about"):
        cp.reconstruct(video, tmp_path / "out", budget=10.0, jobs=1, threads=1)
    record = cp.reconstruct(video, tmp_path / "some", budget=150.0, jobs=None)
    assert record.stages["train"].options["steps"] <= 2000
