"""Depth range of a posed video, from triangulated features."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.jobs import Progress, with_progress
from coliags_plugin.core.scenes import Frame
from coliags_plugin.reconstruction.depth.sweeping import MAX_TURN
from coliags_plugin.reconstruction.structure.features import (
    Features,
    FeatureSettings,
    feature_extractor,
    image_and_mask,
    quiet_colmap,
)
from coliags_plugin.reconstruction.structure.matching import Pose, have_positive_depths, mutual_matches, rays

log = logging.getLogger(__name__)

#: Most frames whose depth is measured, and how many frames later their partners are.
_FRAMES, _STEPS = 16, (1, 2, 4, 8, 16)
#: Least triangulation angle, degrees, and largest Sampson distance, pixels.
_LEAST_ANGLE, _ERROR = 1.0, 1.0
#: Largest ratio in Lowe's test, and distance of descriptors.
_MAX_RATIO, _MAX_DISTANCE = 0.8, 0.7
#: Fewest points that give a range, and that give a frame's own median.
_FEWEST, _FEWEST_OF_FRAME = 30, 10
#: Relative difference within which two partners must agree about a point.
_AGREEMENT = 0.15
#: Difference of log depth from the neighbours' above which a point does not count.
_UNLIKE = 0.3
#: Neighbours of a point in its frame, and how many of them have to agree: a fold's edge leaves one side.
_NEIGHBOURS, _AGREEING = 8, 4
#: Percentiles of the points' depth, and the factors on them: features are rare where the lumen is dark.
_NEAREST, _FARTHEST = (1.0, 0.6), (99.0, 2.0)


@dataclass(frozen=True)
class DepthRange:
    """Nearest and farthest depth of a video, and each frame's median, scene units."""

    near: float
    far: float
    medians: tuple[float, ...]


def given_range(near: float, far: float, count: int) -> DepthRange:
    """The range that a user states; frames' medians are its geometric mean."""
    if not 0.0 < near < far:
        raise InputError(f"`near={near:g}` and `far={far:g}`", "0 < near < far")
    return DepthRange(near, far, (float(np.sqrt(near * far)),) * count)


def find_range(frames: Sequence[Frame], settings: FeatureSettings, progress: Progress | None = None) -> DepthRange:
    """Depth range from points triangulated between pairs of frames, or from sparse depth where the scene has some."""
    if any(frame.sparse_depth is not None and len(frame.sparse_depth.depth) for frame in frames):
        depths_by_frame = [
            np.zeros(0)
            if sparse is None
            else _neighbourly(sparse.pixels.cpu().numpy(), sparse.depth.cpu().double().numpy())
            for sparse in (frame.sparse_depth for frame in frames)
        ]
        return _range_of(depths_by_frame, "points of the scene")
    depths_by_frame = [np.zeros(0)] * len(frames)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_FRAMES, len(frames))).round().astype(int)).tolist()
    with quiet_colmap(0):
        extract = feature_extractor(settings)

        @lru_cache(maxsize=2 * len(_STEPS))
        def features_of(index: int) -> Features:
            return extract(*image_and_mask(frames[index]))

        for index in with_progress(chosen, "find the depth range", progress):
            partners = [index + step for step in _STEPS if index + step < len(frames)]
            partners += [index - step for step in _STEPS if index - step >= 0 and not partners]
            depths = [
                triangulated_depths(features_of(index), features_of(other), frames[index], frames[other])
                for other in partners
            ]
            if depths:
                depths_by_frame[index] = _neighbourly(features_of(index).pixels, _agreed(np.stack(depths)))
    return _range_of(depths_by_frame, "points triangulated between frames")


def triangulated_depths(first: Features, second: Features, frame: Frame, partner: Frame) -> Float[np.ndarray, "K"]:
    """z-depths, in the first frame, of its features with matches on their epipolar lines at a sufficient angle.

    NaN for all others.
    """
    depths = np.full(len(first), np.nan)
    rotation, translation = Pose.of(frame.camera).to(Pose.of(partner.camera))
    turn = np.degrees(np.arccos(np.clip(float(frame.camera.optical_axis @ partner.camera.optical_axis), -1.0, 1.0)))
    if not np.linalg.norm(translation) > 0.0 or turn > MAX_TURN:
        return depths
    pairs = mutual_matches(first, second, _MAX_RATIO, _MAX_DISTANCE)
    turned = rays(first.pixels[pairs[:, 0]], frame.camera) @ rotation.T
    opposite = rays(second.pixels[pairs[:, 1]], partner.camera)
    # Epipolar lines in either image; coefficients of x and y divided by the focal lengths give distances in pixels.
    lines, lines_back = np.cross(translation, turned), np.cross(opposite, translation) @ rotation
    slopes = (
        np.linalg.norm(line[:, :2] / (camera.fx, camera.fy), axis=1)
        for line, camera in ((lines, partner.camera), (lines_back, frame.camera))
    )
    is_on_line = np.abs((opposite * lines).sum(axis=1)) <= _ERROR * np.hypot(*slopes)
    # Depth a of least distance between the lines a * turned + translation and b * opposite.
    aa, bb, ab = (np.einsum("ij,ij->i", *pair) for pair in ((turned, turned), (opposite, opposite), (turned, opposite)))
    sine = 1.0 - ab**2 / (aa * bb)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (ab * (opposite @ translation) - bb * (turned @ translation)) / (aa * bb - ab**2)
    good = is_on_line & (sine > np.sin(np.radians(_LEAST_ANGLE)) ** 2)
    good &= have_positive_depths(turned, opposite, translation)
    depths[pairs[good, 0]] = depth[good]
    return depths


def _agreed(depths: Float[np.ndarray, "P K"]) -> Float[np.ndarray, "K"]:
    """Median depths of the features about which two partners agree, and most do; NaN for all others."""
    there = (~np.isnan(depths)).sum(axis=0)
    agreed = np.full(depths.shape[1], np.nan)
    enough = there >= min(2, len(depths))
    agreed[enough] = np.nanmedian(depths[:, enough], axis=0)
    near = (np.abs(depths / agreed - 1.0) <= _AGREEMENT).sum(axis=0)
    return np.where((near >= np.minimum(2, there)) & (2 * near > there), agreed, np.nan)


def _neighbourly(pixels: Float[np.ndarray, "K 2"], depths: Float[np.ndarray, "K"]) -> Float[np.ndarray, "A"]:
    """Depths of one frame that are known, above 0, and not unlike their neighbours'."""
    is_known = depths > 0.0
    depths = depths[is_known]
    return np.asarray(depths[~(difference_from_neighbours(pixels[is_known], np.log(depths)) > _UNLIKE)])


def difference_from_neighbours(
    pixels: Float[np.ndarray, "K 2"], log_depth: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "K"]:
    """Difference of log depths of one frame from half of the nearest observations; NaN in a frame with too few."""
    if len(pixels) <= _NEIGHBOURS:
        return np.full(len(pixels), np.nan)
    nearest = np.asarray(cKDTree(pixels).query(pixels, _NEIGHBOURS + 1)[1])[:, 1:]
    differences = np.abs(log_depth[nearest] - log_depth[:, None])
    return np.asarray(np.partition(differences, _AGREEING - 1, axis=1)[:, _AGREEING - 1])


def _range_of(depths_by_frame: Sequence[Float[np.ndarray, "K"]], what: str) -> DepthRange:
    every = np.concatenate(depths_by_frame)
    if len(every) < _FEWEST:
        raise InputError(
            f"the depth range is unknown: {len(every)} {what}",
            f"at least {_FEWEST}: sharp, overlapping frames of a camera that moves, with correct poses",
            "Check the poses (coliags data check), use frames farther apart, or give `near` and `far`",
        )
    near, far = (factor * float(np.percentile(every, part)) for part, factor in (_NEAREST, _FARTHEST))
    measured = [index for index, depths in enumerate(depths_by_frame) if len(depths) >= _FEWEST_OF_FRAME]
    if measured:
        medians = np.interp(
            np.arange(len(depths_by_frame)), measured, np.log([np.median(depths_by_frame[index]) for index in measured])
        )
    else:
        medians = np.full(len(depths_by_frame), np.log(np.median(every)))
    log.info("depths of %.4g to %.4g are tried, by %d %s", near, far, len(every), what)
    return DepthRange(near, far, tuple(float(value) for value in np.exp(medians)))
