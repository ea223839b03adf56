"""Sharpness of frames, motion between them, and the choice of those that are of use."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice, pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from coliags_plugin.core.arrays import dilated
from coliags_plugin.pipeline.settings import FrameSettings
from coliags_plugin.reconstruction.structure.image_files import is_repeated

#: Larger side of the images that are measured, pixels.
_SIDE = 480
#: Corners that are followed, at most, and fewest for a motion.
_CORNERS, _FEWEST = 200, 12
#: Width of the surroundings of a corner, which have to be of the lens's image, pixels.
_RIM = 9
#: Largest distance between a corner and where following it there and back ends, pixels.
_RETURN = 0.5
#: Neighbours to either side, of the frames left by thinning, that a frame's sharpness is compared with.
_NEIGHBOURS = 10
#: Brightness (of 255) that a pixel outside of the lens's image never exceeds, and pixels by which that is widened.
_DARK, _MARGIN = 16, 3
#: Shares of the image between which a dark border is believed.
_BORDER = (0.002, 0.7)
#: A pixel that changes by less than this over the video, of 255, is still; the others change by at least twice as much
#: (median), or the camera rests. Largest share of them, and least gradient of the mean image at an overlay, per pixel:
#: what moves leaves up to 6.
_STILL, _OVERLAYS, _EDGE = 48, 0.3, 10.0

#: Ratio of the differences of neighbouring rows and of rows two apart above which a frame is interlaced: 0.5 to 0.7 in
#: images, 1 for noise alone, 1.1 where that is sharpened, 1.4 to 9 where two fields show a scene that moves fast. Slow
#: motion combs little: hence the percentile, over frames that change, of a video's ratios.
_INTERLACED, _PERCENTILE = 1.3, 90.0
#: Frames that change which are looked at, from the first on, and frames among which they are sought.
_CHANGING, _LOOKED_AT = 300, 3000

#: Why frames are dropped, as the record says it.
THINNED, EMPTY, RESTING = "thinned out", "black or without any texture", "the camera rests"


def sharpest_frames(
    sharpness: Sequence[float], settings: FrameSettings, times: Float64[np.ndarray, "N"] | None = None
) -> tuple[list[int], dict[int, str]]:
    """Frames to use by the sharpness of every frame: ascending indices, and why each of the others is dropped.

    ``times``, s, count for ``settings.per_second``.
    """
    values, part = np.asarray(sharpness), np.arange(len(sharpness)) // settings.every
    if settings.per_second is not None and times is not None:
        part = np.floor(times * settings.per_second + 1e-6).astype(int)
    bounds = [*np.flatnonzero(np.diff(part, prepend=-1)).tolist(), len(values)]
    best = [first + int(np.argmax(values[first:stop])) for first, stop in pairwise(bounds)]
    dropped = dict.fromkeys(set(range(len(values))) - set(best), THINNED)
    some = [index for index in best if values[index] > 0.0]
    return some, dropped | dict.fromkeys(set(best) - set(some), EMPTY)


def blurred_frames(chosen: Sequence[int], sharpness: Sequence[float], settings: FrameSettings) -> set[int]:
    """Frames among the chosen ones, ascending, that are much less sharp than those around them."""
    values = np.asarray(sharpness)
    return {
        index
        for place, index in enumerate(chosen)
        if values[index]
        < settings.least_sharpness * np.median(values[chosen[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]])
    }


def lens_mask(brightest: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"] | None:
    """Mask of a lens's image within black surroundings; None where the image has none.

    False where a pixel is dark in every frame and connected to the image's edge. ``brightest`` is the largest value of
    each pixel in any channel of any frame.
    """
    dark = (brightest <= _DARK).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark)
    rim = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    outside = np.isin(labels, rim[rim > 0]) & (dark > 0)
    share = float(outside.mean())
    return ~dilated(outside, _MARGIN) if _BORDER[0] <= share <= _BORDER[1] else None


def overlays(
    darkest: UInt8[np.ndarray, "H W 3"], brightest: UInt8[np.ndarray, "H W 3"], mean: Float32[np.ndarray, "H W 3"]
) -> Bool[np.ndarray, "H W"]:
    """Text, logos and frames within the picture: what never changes, with edges, while the rest does.

    True there. ``darkest`` and ``brightest`` are the extremes of each pixel over the frames, ``mean`` its mean.
    """
    change = (brightest - darkest).max(axis=2)
    dark = brightest.max(axis=2) <= _DARK
    still = (change <= _STILL) & ~dark
    others = change[~dark & ~still]
    if not still.any() or still.sum() > _OVERLAYS * (~dark).sum() or np.median(others) < 2 * _STILL:
        return np.zeros(still.shape, bool)
    slope = np.zeros(still.shape, np.float32)
    for number in range(3):  # one channel after the other, for the memory of large frames
        channel = np.ascontiguousarray(mean[..., number])
        slopes = (cv2.Sobel(channel, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
        np.maximum(slope, np.hypot(*slopes), out=slope)
    _, labels = cv2.connectedComponents(dilated(still, 1).astype(np.uint8))
    marked = np.unique(labels[still & dilated(slope > _EDGE, 1)])
    return dilated(np.isin(labels, marked[marked > 0]), _MARGIN)


def _combing(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """Mean difference of green between neighbouring rows, relative to that between rows two apart."""
    green = image[..., 1].astype(np.int16)
    return float(np.abs(green[1:] - green[:-1]).mean() / max(np.abs(green[2:] - green[:-2]).mean(), 1e-6))


def looks_interlaced(images: Iterable[UInt8[np.ndarray, "H W 3"]]) -> bool:
    """True if frames of a video show two moments each, by the first of them that differ from the one before."""
    combs, last = list[float](), None
    for image in islice(images, _LOOKED_AT):
        if last is not None and not is_repeated(last, image):
            combs.append(_combing(image))
        last = image
        if len(combs) == _CHANGING:
            break
    return bool(combs) and bool(np.percentile(combs, _PERCENTILE) > _INTERLACED)


def one_field(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """A frame of one moment: the even rows, from the first, and means of those above and below in place of the odd.

    The rows of an interlaced frame show two moments in turn, while a pose is that of one. Which is the earlier does not
    matter: the even rows of all frames are equally far apart in time.
    """
    whole = image.copy()
    whole[1::2] = image[:-1:2]  # the last row has none below
    whole[1:-1:2] = (image[:-2:2].astype(np.uint16) + image[2::2] + 1) // 2
    return whole


def reduced(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w"]:
    """The grey image at the size at which frames are measured."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    factor = _SIDE / max(gray.shape)
    if factor >= 1.0:
        return gray
    size = (max(1, round(gray.shape[1] * factor)), max(1, round(gray.shape[0] * factor)))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def corner_motion(
    before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"], mask: Bool[np.ndarray, "H W"] | None = None
) -> tuple[float, float]:
    """Median displacement of corners as a share of the larger side, infinity for too few, and the share followed.

    ``mask``, of the frames before they were reduced, is False where corners do not count, as on text, which rests.
    """
    counted = None
    if mask is not None:
        counted = cv2.resize(mask.astype(np.uint8), before.shape[::-1], interpolation=cv2.INTER_NEAREST)
        counted = cv2.erode(counted, np.ones((_RIM, _RIM), np.uint8))
    # The colon's wall is smooth, and the lamp's brightness changes: local contrast is enhanced.
    first, second = (cv2.createCLAHE(4.0, (8, 8)).apply(gray) for gray in (before, after))
    corners = cv2.goodFeaturesToTrack(first, _CORNERS, 0.01, 8, mask=counted)
    if corners is None or len(corners) < _FEWEST:
        return float("inf"), 0.0
    moved, is_tracked, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None)
    back, is_tracked_back, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, None)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < _RETURN
    survived = (is_tracked[:, 0] > 0) & (is_tracked_back[:, 0] > 0) & returned
    if survived.sum() < _FEWEST:
        return float("inf"), float(survived.sum()) / _CORNERS
    lengths = np.linalg.norm(moved - corners, axis=2)[survived, 0]
    return float(np.median(lengths)) / max(before.shape), float(survived.sum()) / _CORNERS
