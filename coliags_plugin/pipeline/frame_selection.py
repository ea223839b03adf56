"""Choice of the frames of a video that are sharp."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8

from coliags_plugin.core.morphology import dilated
from coliags_plugin.pipeline.settings import FrameSettings

#: Neighbours to either side, of the frames left by thinning, that a frame's sharpness is compared with.
_NEIGHBOURS = 10
#: Brightness (of 255) that a pixel outside of the lens's image never exceeds, and pixels by which that is widened.
_DARK, _MARGIN = 16, 3
#: Shares of the image between which a dark border is believed.
_BORDER = (0.002, 0.7)

#: Why frames are dropped, as the record says it.
THINNED, BLURRED, EMPTY, RESTING = "thinned out", "blurred", "black or without any texture", "the camera rests"


def interval(count: int, settings: FrameSettings) -> int:
    """Of so many frames one is used.

    Args:
        count: Frames of the video.
        settings: Which to use.
    """
    return settings.every or max(1, math.ceil(count / settings.at_most))


def sharp_frames(sharpness: Sequence[float], settings: FrameSettings) -> tuple[list[int], dict[int, str]]:
    """Frames to use, by their sharpness alone.

    Args:
        sharpness: Of every frame of the video.
        settings: Which to use.

    Returns:
        Indices, ascending; and why each of the others is dropped.
    """
    values, step = np.asarray(sharpness), interval(len(sharpness), settings)
    best = [first + int(np.argmax(values[first : first + step])) for first in range(0, len(values), step)]
    dropped = dict.fromkeys(set(range(len(values))) - set(best), THINNED)
    some = [index for index in best if values[index] > 0.0]
    dropped |= dict.fromkeys(set(best) - set(some), EMPTY)
    kept = []
    for position, index in enumerate(some):
        around = some[max(0, position - _NEIGHBOURS) : position + _NEIGHBOURS + 1]
        if values[index] < settings.least_sharpness * np.median(values[around]):
            dropped[index] = BLURRED
        else:
            kept.append(index)
    return kept, dropped


def lens_mask(brightest: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"] | None:
    """Mask of a lens's image within black surroundings; None where the image has none.

    Args:
        brightest: The largest value of each pixel in any channel of any frame. [H, W]

    Returns:
        False where a pixel is dark in every frame and connected to the image's edge. [H, W]
    """
    import cv2

    dark = (brightest <= _DARK).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark)
    rim = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    outside = np.isin(labels, rim[rim > 0]) & (dark > 0)
    share = float(outside.mean())
    return ~dilated(outside, _MARGIN) if _BORDER[0] <= share <= _BORDER[1] else None
