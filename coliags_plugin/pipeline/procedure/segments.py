"""Cuts a surveyed video into segments, and leaves out what cannot be posed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from coliags_plugin.pipeline.procedure.survey import Survey
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.reconstruction.structure.video import cut_where_lost

#: Share of corners below which a frame shows nothing of the one before: wall contact, blur, wash, or a cut.
_NOTHING = 0.06
#: Share of the video's median sharpness below which corners are noise of the sensor and of compression, which may be
#: followed: wall contact has 0.10 to 0.13, the least sharp of a patient's frames of use 0.28.
_FLAT = 0.2
#: Frames without a break of which a stretch of such frames is left out; shorter ones stay within their segment.
_LONGEST_LOSS = 30
#: Frames that two segments share where a video is cut although points are followed, so that they can be joined.
OVERLAP = 24


@dataclass(frozen=True)
class Stretch:
    """Frames of a video by their numbers, both inclusive."""

    first: int
    last: int

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class Segment(Stretch):
    """Frames that are reconstructed by themselves."""

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$")]  # of the folder


@dataclass(frozen=True)
class Skipped(Stretch):
    """Frames that are left out."""

    why: str = ""


def cut(survey: Survey, settings: FrameSettings, least: int) -> tuple[list[Stretch], list[Skipped]]:
    """Segments in order, and what is left out: where nothing is followed for long, and what is shorter than ``least``.

    Segments that follow each other without a gap share at most ``OVERLAP`` frames, times ``settings.every``.
    """
    flat = survey.sharpness <= _FLAT * np.median(survey.sharpness)
    lost = flat | (survey.followed < _NOTHING)
    lost[0] = flat[0]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(np.int8), [0]])))
    gaps = [(first, stop) for first, stop in edges.reshape(-1, 2).tolist() if stop - first > _LONGEST_LOSS]
    bounds = [0, *(place for gap in gaps for place in gap), len(survey)]
    skipped = [Skipped(first, stop - 1, "nothing of the frame before is seen, or no texture") for first, stop in gaps]
    segments: list[Stretch] = []
    for start, stop in zip(bounds[::2], bounds[1::2], strict=True):
        if 0 < stop - start < least * settings.every:
            skipped.append(Skipped(start, stop - 1, f"fewer than {least} frames of use between such stretches"))
        elif stop > start:
            segments += _split(survey, start, stop, settings)
    return segments, sorted(skipped, key=lambda stretch: stretch.first)


def _split(survey: Survey, start: int, stop: int, settings: FrameSettings) -> list[Stretch]:
    # Stretches are not shorter than a quarter of the longest, so that no frame is in more than two segments.
    shared = min(OVERLAP, settings.segment // 8) * settings.every
    longest = settings.segment * settings.every - shared
    windows = cut_where_lost(survey.followed[start:stop].tolist(), longest)
    half = shared // 2
    return [
        Stretch(max(start, start + window.start - half), min(stop, start + window.stop + half) - 1)
        for window in windows
    ]
