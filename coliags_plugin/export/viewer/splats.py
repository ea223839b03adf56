"""Gaussians of a run for the view of a browser, merged into fewer, and as the browser takes them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from coliags_plugin.contracts import GaussianField, gaussians_under
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.export.splats.cloud import SplatCloud, harmonics_of_colors
from coliags_plugin.geometry.poses.rigid import wxyz_from_rotations
from coliags_plugin.lighting.lamps import HeldLight

#: How much wider than the view, on every side, Gaussians are decoded, so that a small turn shows no gap.
MARGIN = 1.25
#: Bytes of one splat on the wire: centre float32 x 3, unused, covariance float16 x 6, RGBA.
BYTES_PER_SPLAT = 32
#: Largest entry of a covariance: the largest of half precision is 65504.
_LARGEST_COVARIANCE = 6.0e4
#: Median standard deviation of the splats in the units that covariances are sent in.
_MEDIAN_SIGMA = 0.125


def shown(gaussians: Gaussians) -> SplatCloud:
    """Gaussians to draw: finite ones, with three scales each, of which surfels have one that is 0."""
    return SplatCloud.of(gaussians).with_thickness(0.0)


def wire_unit(splats: SplatCloud) -> float:
    """Length, in scene units, that centres and covariances are sent in multiples of: a power of two.

    The browser holds covariances in half precision. In this unit those of the median splat are well within its range,
    whatever the scene's unit of length; the unit is undone by the scale of the scene node, so that positions, cameras
    and meshes stay in scene units (mm).
    """
    if not len(splats):
        return 1.0
    sigma = float(np.median(np.linalg.norm(splats.scales, axis=1) / 3.0**0.5))
    return 2.0 ** round(math.log2(sigma / _MEDIAN_SIGMA)) if sigma > 0.0 else 1.0


def on_wire(splats: SplatCloud, unit: float) -> dict[str, Any]:
    """Arguments of viser's ``add_gaussian_splats`` and ``set_gaussians``, in multiples of :func:`wire_unit`.

    Splats too large for half precision are made as large as it allows, round ones and flat ones alike.
    """
    covariances = splats.covariances / np.float32(unit * unit)
    largest = np.abs(covariances).max(axis=(1, 2), initial=0.0)
    covariances *= np.minimum(1.0, _LARGEST_COVARIANCE / np.maximum(largest, 1.0))[:, None, None]
    return {
        "centers": splats.means / np.float32(unit),
        "covariances": covariances,
        "rgbs": np.rint(255.0 * splats.colors).astype(np.uint8),
        "opacities": splats.opacities[:, None],
    }


class ViewDecoder:
    """Decodes a field for a view, and takes what lies beside it from other Gaussians of the whole scene.

    A field yields the Gaussians that a camera sees; without the others, a turn of the head would show nothing until
    the next decoding.
    """

    def __init__(self, field: GaussianField, beside: SplatCloud, device: torch.device) -> None:
        self.beside = beside
        self._field = field
        self._device = device

    @torch.no_grad()
    def of(self, camera: Camera, light: HeldLight | None = None) -> SplatCloud:
        """Gaussians with their colours, and, of anchor methods, their shapes, as this camera sees them.

        They are in this light, or in that of the lamp on the camera.
        """
        wide = widened(camera).to(self._device)
        seen = shown(gaussians_under(self._field, wide, light))
        return seen.concat(self.beside.part(~in_view(self.beside.means, wide)))


def widened(camera: Camera) -> Camera:
    """The camera with a field of view wider by :data:`MARGIN`, tangents compared."""
    return replace(camera, fx=camera.fx / MARGIN, fy=camera.fy / MARGIN)


def in_view(points: Float[np.ndarray, "N 3"], camera: Camera) -> Bool[np.ndarray, "N"]:
    """Whether points, in the world frame, are in front of a camera and within its image. [N]"""
    _, inside = camera.to("cpu", torch.float64).sees(torch.as_tensor(points, dtype=torch.float64))
    return np.asarray(inside.numpy())


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
