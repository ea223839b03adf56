"""What a reconstruction is expected to take."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.pipeline.forecast import forecast
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
