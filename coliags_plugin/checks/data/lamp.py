"""Rank correlation of image brightness with distance from the camera, negative under a lamp at the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats
import torch
from jaxtyping import Float

from coliags_plugin.core.scenes import Frame

#: Largest number of frames and of pixels per frame.
_FRAMES, _PIXELS = 16, 4000
#: Fewest pixels of a frame.
_ENOUGH = 30
#: Grey levels outside these are clipped.
_DARKEST, _BRIGHTEST = 3, 253
#: Smallest ratio of the 90th to the 10th percentile of the distances in a frame.
_DEEP = 1.15


@dataclass(frozen=True)
class LampFacts:
    """Rank correlation (Spearman's) of brightness and distance from the camera within frames.

    Attributes:
        correlation: Median of the frames; -1 where every farther pixel is darker.
        rising_share: Share of the frames in which it is positive.
        frames: Number of frames.
    """

    correlation: float
    rising_share: float
    frames: int


def lamp_facts(frames: Sequence[Frame]) -> LampFacts | None:
    """Correlation of brightness with distance in an even sample of the frames; None where none has enough depth."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).astype(int))
    found = [value for place in chosen if (value := _correlation(frames[place])) is not None]
    if not found:
        return None
    return LampFacts(float(np.median(found)), float(np.mean(np.array(found) > 0.0)), len(found))


def _correlation(frame: Frame) -> float | None:
    """Correlation in one frame, from its dense depth or else its single points; None if these are too few or as far."""
    pixels, depth = _known(frame)
    brightness = frame.image.numpy()[pixels[:, 1], pixels[:, 0]]
    clear = (brightness.min(axis=1) > _DARKEST) & (brightness.max(axis=1) < _BRIGHTEST)
    clear &= frame.valid.numpy()[pixels[:, 1], pixels[:, 0]]
    if clear.sum() < _ENOUGH:
        return None
    rays = frame.camera.rays_at(torch.from_numpy(pixels[clear])).double().norm(dim=1).numpy()
    distance = depth[clear] * rays
    near, far = np.quantile(distance, (0.1, 0.9))
    mean = brightness[clear].mean(axis=1)
    if far < _DEEP * near or mean.min() == mean.max():
        return None
    return float(scipy.stats.spearmanr(mean, distance).statistic)


def _known(frame: Frame) -> tuple[np.ndarray, Float[np.ndarray, "K"]]:
    """Columns and rows of pixels of known depth [K, 2], and their z-depth [K]."""
    dense, sparse = frame.depth, frame.sparse_depth
    if dense is not None:
        row, column = np.nonzero(np.isfinite(dense.numpy()))
        every = max(1, len(row) // _PIXELS)
        row, column = row[::every], column[::every]
        return np.stack([column, row], axis=1), dense.numpy()[row, column].astype(np.float64)
    if sparse is None:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    places = sparse.pixels.floor().long().numpy()
    limits = np.array([frame.camera.width, frame.camera.height]) - 1
    return places.clip(0, limits), sparse.depth.double().numpy()
