"""Pairs of frames of a video whose cameras are a short baseline apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coliags_plugin.checks.data.facts import moving_step
from coliags_plugin.core.scenes import Frame

#: Number of frame pairs.
PAIRS = 12
#: Steps count as at most this many typical ones, so that no jump takes all pairs.
_LONGEST_STEP = 3.0


def video_pairs(frames: Sequence[Frame], farther: int = 1, count: int = PAIRS) -> list[tuple[Frame, Frame]]:
    """Pairs of frames with a short baseline: long enough to reveal wrong poses, short enough to overlap.

    They are spread evenly over the way that the camera goes, not over time, so that none lies in a pause.

    Args:
        frames: Frames of the video.
        farther: Factor on the default baseline, a thirtieth of the way and at most ten mean steps.
        count: Largest number of pairs.
    """
    video = sorted(frames, key=lambda frame: frame.index)
    apart = min(farther * min(max(1, round(len(video) / 30)), 10), max(1, len(video) - 1))
    if len(video) <= apart:
        return []
    centers = np.stack([frame.camera.center.double().numpy() for frame in video])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    typical = moving_step(steps)
    # A camera that does not move has gone one step a frame, in effect.
    counted = np.minimum(steps, _LONGEST_STEP * typical) if typical > 0.0 else np.ones_like(steps)
    way = np.concatenate([[0.0], np.cumsum(counted)])
    baseline = way[-1] * apart / (len(video) - 1) * (1.0 - 1e-9)
    # The last frame of a pause, and the first that is far enough from it.
    first = np.searchsorted(way, np.linspace(0.0, way[-1] - baseline, count), side="right") - 1
    second = np.minimum(np.searchsorted(way, way[first] + baseline), len(video) - 1)
    return [
        (video[here], video[there]) for here, there in dict.fromkeys(zip(first, second, strict=True)) if here < there
    ]
