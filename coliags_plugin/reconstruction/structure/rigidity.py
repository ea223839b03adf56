"""Rigidity of what a video shows: how far tracks are from one epipolar geometry, against the time between frames."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.reconstruction.structure.point_tracks import FramePoints

if TYPE_CHECKING:
    import pycolmap

#: Numbers of frames apart, most pairs of frames of each, and fewest, below which nothing is said.
_APART, _MOST_PAIRS, _FEWEST_PAIRS = (1, 2, 4, 8, 12, 16, 24, 32), 24, 4
#: Fewest tracks of a pair, and its tangents of angles to the axis up to which they count: farther out pixels stretch.
_FEWEST, _WIDEST = 40, 1.2
#: RANSAC inlier threshold, radians, and each so many of the tracks is kept from the fit and measured.
_MAX_ERROR, _TESTED = 0.01, 3
#: Residual beyond which a rigid model averages motion, times that of neighbours, and at least, radians: on a rigid
#: wall that is hard to track it stays below the second (docs/poses.md 9.4).
_LIMIT, _LEAST_LIMIT = 3.0, 0.007


def rigidity(model: pycolmap.Reconstruction, tracks: Sequence[FramePoints]) -> dict[int, float]:
    """Residual of the best rigid motion, pixels, by the number of frames that two frames of a model are apart.

    For pairs of frames spread over the model, an essential matrix is fitted to two thirds of their common tracks,
    whatever their poses; of the other third the median distance from its epipolar lines is taken, and of this the
    median over the pairs. Noise of the tracks alone grows slowly with the distance; a wall that moves adds to it.
    Distances over which fewer than four pairs have 40 tracks in common are left out. Image i has ID i + 1.
    """
    frames = sorted(number - 1 for number in model.reg_image_ids())
    camera = model.images[frames[0] + 1].camera
    directions = {frame: np.asarray(camera.cam_from_img(tracks[frame].pixels.astype(np.float64))) for frame in frames}
    measured = {}
    for apart in _APART:
        pairs = [(first, first + apart) for first in frames if first + apart in directions]
        values = []
        for first, second in pairs[:: 1 + len(pairs) // _MOST_PAIRS]:
            _, one, other = np.intersect1d(
                tracks[first].ids, tracks[second].ids, assume_unique=True, return_indices=True
            )
            value = _residual(directions[first][one], directions[second][other])
            values += [] if value is None else [value]
        if len(values) >= _FEWEST_PAIRS:
            measured[apart] = float(np.median(values)) * camera.mean_focal_length()
    return measured


def rigid_frames(model: pycolmap.Reconstruction, tracks: Sequence[FramePoints]) -> int | None:
    """Maximum number of frames of a model for its scene to count as rigid; None: no limit by its :func:`rigidity`.

    No frame is farther from the middle one than residuals take to reach three times that of neighbours and 0.007 of
    the focal length.
    """
    residuals = sorted(rigidity(model, tracks).items())
    for (near, below), (far, value) in pairwise(residuals):
        focal_length = next(iter(model.cameras.values())).mean_focal_length()
        limit = max(_LIMIT * residuals[0][1], _LEAST_LIMIT * focal_length)
        if value > limit:
            return 1 + 2 * int(near + (far - near) * max(0.0, limit - below) / (value - below))
    return None


def _residual(first: Float[np.ndarray, "K 2"], second: Float[np.ndarray, "K 2"]) -> float | None:
    """Median distance of tracks from the epipolar geometry of others, tangents; None for too few."""
    import cv2

    inside = (np.linalg.norm(first, axis=1) < _WIDEST) & (np.linalg.norm(second, axis=1) < _WIDEST)
    one, other = (np.column_stack([points[inside], np.ones(inside.sum())]) for points in (first, second))
    if len(one) < _FEWEST:
        return None
    tested = np.arange(len(one)) % _TESTED == 0
    fitted = one[~tested, :2], other[~tested, :2]
    essential, _ = cv2.findEssentialMat(*fitted, np.eye(3), cv2.RANSAC, 0.999, _MAX_ERROR)
    if essential is None:
        return None
    lines, back = one[tested] @ essential[:3].T, other[tested] @ essential[:3]
    slopes = np.hypot(np.linalg.norm(lines[:, :2], axis=1), np.linalg.norm(back[:, :2], axis=1))
    return float(np.median(np.abs((other[tested] * lines).sum(axis=1)) / np.maximum(slopes, 1e-12)))
