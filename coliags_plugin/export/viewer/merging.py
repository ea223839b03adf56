"""Fewer Gaussians for the same surface, by merging neighbours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.export.splats.cloud import SplatCloud, harmonics_of_colors
from coliags_plugin.geometry.poses.rigid import wxyz_from_rotations

#: Largest opacity whose optical depth is counted: that of 1 is infinite.
_MOST_OPAQUE = 0.999
#: Attempts at the edge of the cells; it is found when the number is at least this share of the largest one.
_ATTEMPTS = 20
_AIM, _ENOUGH = 0.98, 0.95
#: Factor of the variance of the members' centres within a merged splat. Splats on a grid of step 1 look smooth from a
#: standard deviation of about 0.45 on; that of a square's points about its middle is 0.29.
_SPREAD = 2.0


def merged_to(splats: SplatCloud, count: int, distances: Float[np.ndarray, "N"]) -> SplatCloud:
    """At most so many splats: those of a similar size within a cell of a grid become one.

    The cells are the smallest for which there are few enough. Those at twice the distance are twice as large, so that
    all look alike in size.
    """
    if len(splats) <= count:
        return splats
    sizes = _octaves(splats.scales.max(axis=1))
    levels = _octaves(distances)
    classes = np.stack([sizes, levels], axis=1)
    scaled = splats.means / (2.0**levels)[:, None]
    extent = float(np.ptp(scaled, axis=0).max()) + 1e-6
    low, high, edge = 0.0, extent, extent / count**0.5
    best = np.zeros(len(splats), np.int64)
    for _ in range(_ATTEMPTS):
        cells = _cells(scaled / edge, classes)
        number = int(cells.max()) + 1
        if number <= count:
            best, high = cells, edge
            if number >= _ENOUGH * count:
                break
        else:
            low = edge
        # Cells on a surface: their number falls with the square of the edge.
        aimed = edge * (number / (_AIM * count)) ** 0.5
        edge = aimed if low < aimed < high else 0.5 * (low + high)
    return merged(splats, best)


def merged(splats: SplatCloud, groups: Int[np.ndarray, "N"]) -> SplatCloud:
    """One splat for each group, of the same mean, covariance and colour as its members together.

    Members weigh by their optical depth -ln(1 - opacity) times the area they cover; the group's optical depth spreads
    the sum of these over the area of the merged splat. Groups are numbered from 0 on without gaps.
    """
    depth = -np.log1p(-np.minimum(splats.opacities.astype(np.float64), _MOST_OPAQUE))
    weights = depth * area(splats.scales)
    weights = np.maximum(weights, np.finfo(np.float64).tiny)
    total = np.bincount(groups, weights)

    def mean(values: np.ndarray) -> np.ndarray:
        """Weighted mean of each group. [G, C]"""
        return np.stack([np.bincount(groups, weights * column) / total for column in values.T.astype(np.float64)], 1)

    centers = mean(splats.means)
    away = splats.means - centers[groups]
    second = splats.covariances + _SPREAD * away[:, :, None] * away[:, None, :]
    covariances = mean(second.reshape(-1, 9)).reshape(-1, 3, 3)
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(variances.clip(0.0))
    opacities = -np.expm1(-total / np.maximum(area(scales), np.finfo(np.float64).tiny))
    return SplatCloud(
        means=centers.astype(np.float32),
        quats_wxyz=wxyz_from_rotations(axes).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=opacities.astype(np.float32),
        harmonics=harmonics_of_colors(mean(splats.colors)),
    )


def area(scales: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
    """Product of the two largest standard deviations: what a splat covers, seen from the front. [N]"""
    return np.asarray(np.sort(scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1))


def _octaves(lengths: Float[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """Whole octaves of lengths above the shortest. [N]"""
    octaves = np.floor(np.log2(np.maximum(lengths, np.finfo(np.float32).tiny)))
    return np.asarray(octaves - octaves.min(), np.int64)


def _cells(scaled: Float[np.ndarray, "N 3"], classes: Int[np.ndarray, "N C"]) -> Int[np.ndarray, "N"]:
    """Number of the cell and class of each splat, without gaps; places are in edges of the cells."""
    keys = np.floor(scaled - scaled.min(0)).astype(np.int64)
    keys = np.concatenate([keys, classes], axis=1)
    spans = tuple(int(span) for span in keys.max(0) + 1)
    return np.unique(np.ravel_multi_index(tuple(keys.T), spans), return_inverse=True)[1]
