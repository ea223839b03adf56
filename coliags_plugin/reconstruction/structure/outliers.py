"""Depths of observed points that contradict their neighbours or the lamp at the lens."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from coliags_plugin.reconstruction.robust_fit import robust_fit

#: Neighbours of an observation in its frame, and how many of them have to agree: a fold's edge leaves one side.
_NEIGHBOURS, _AGREEING = 8, 4
#: Exponent of depth by the law of a lamp at the lens: stored value ~ (1 / depth^2)^(1 / 2.2), and its weight in rows.
_LAW, _LAW_WEIGHT = -1.1, 20.0
#: Median exponent above which the light does not come from the lens: 0 in daylight, -0.6 to -1.4 in colons.
_LEAST_LIT = -0.3


def difference_from_neighbours(
    pixels: Float[np.ndarray, "K 2"], log_depth: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "K"]:
    """How far log depths of one frame are from half of the nearest observations; NaN in a frame with too few."""
    if len(pixels) <= _NEIGHBOURS:
        return np.full(len(pixels), np.nan)
    nearest = np.asarray(cKDTree(pixels).query(pixels, _NEIGHBOURS + 1)[1])[:, 1:]
    differences = np.abs(log_depth[nearest] - log_depth[:, None])
    return np.asarray(np.partition(differences, _AGREEING - 1, axis=1)[:, _AGREEING - 1])


def difference_from_lamp(
    brightness: Float[np.ndarray, "K"], log_depth: Float[np.ndarray, "K"], frames: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "K"]:
    """How far log depths are from a robust line over log brightness in each frame, in robust standard deviations.

    NaN if brightness tells nothing about depth, as without a lamp at the lens. ``brightness``: 0 to 255.
    """
    left, slopes = np.empty(len(frames)), []
    columns = np.stack([np.ones(len(frames)), np.log(brightness + 1.0)], axis=1)
    for frame in np.unique(frames):
        here = frames == frame
        wanted, rows = log_depth[here], columns[here]
        law = np.array([np.median(wanted - _LAW * rows[:, 1]), _LAW])
        line = robust_fit(rows, wanted, np.ones(len(wanted)), law, _LAW_WEIGHT)
        left[here] = np.abs(wanted - rows @ line)
        slopes.append(line[1])
    deviation = 1.4826 * np.median(left) if len(left) else 0.0
    tells = deviation > 0.0 and np.median(slopes) <= _LEAST_LIT
    return np.asarray(left / deviation) if tells else np.full(len(left), np.nan)


def median_of_points(
    values: Float[np.ndarray, "K"], points: Int[np.ndarray, "K"], count: int
) -> Float[np.ndarray, "N"]:
    """Lower median of each point's observations that are not NaN; 0 for a point without any."""
    known = ~np.isnan(values)
    values, points = values[known], points[known]
    order = np.lexsort((values, points))
    counts = np.bincount(points, minlength=count)
    middle = np.cumsum(counts) - counts + np.maximum(counts - 1, 0) // 2
    medians = np.zeros(count)
    medians[counts > 0] = values[order][middle[counts > 0]]
    return medians
