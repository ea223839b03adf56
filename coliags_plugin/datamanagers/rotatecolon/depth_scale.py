"""Estimates the scale of depth relative to points on the same surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.recording import Shot

#: Most frames, pixels per frame and points that are compared.
_FRAMES, _PIXELS, _POINTS = 6, 100, 50_000
#: Grid search over the scale, coarse to fine: (largest factor, number of steps) of each round.
_ROUNDS = ((3.0, 31), (1.08, 17), (1.01, 11))


@dataclass(frozen=True)
class ScaleFit:
    """Fit of back-projected depth to points of the same surface: the best factor on depth.

    The distances are the median distance of back-projected pixels to their nearest point, relative to z-depth, at scale
    1 and at the best scale.
    """

    factor: float
    distance: float
    distance_at_best: float

    @property
    def disagrees(self) -> bool:
        """Whether the best scale is more than 5 % off 1 and halves the distance."""
        return abs(self.factor - 1.0) > 0.05 and self.distance_at_best < 0.5 * self.distance


def fit_scale(shots: Sequence[Shot], points: Float[np.ndarray, "N 3"]) -> ScaleFit | None:
    """Fit the scale of the depth of a few pinhole frames to points of the surface, by nearest-neighbour distances.

    Points are in the world of the poses. None where there is no depth or no points.
    """
    from scipy.spatial import cKDTree

    points = points[np.isfinite(points).all(axis=1)]
    with_depth = [shot for shot in shots if shot.depth is not None]
    indices = np.unique(np.linspace(0, len(with_depth) - 1, min(_FRAMES, len(with_depth))).round().astype(int))
    generator = np.random.default_rng(0)
    centers, rays, depths = [], [], []
    for index in indices:
        center, ray, depth = _sampled(with_depth[index], generator)
        centers.append(np.broadcast_to(center, ray.shape))
        rays.append(ray)
        depths.append(depth)
    depth = np.concatenate(depths) if depths else np.zeros(0)
    if not len(depth) or not len(points):
        return None
    if len(points) > _POINTS:
        points = points[generator.choice(len(points), _POINTS, replace=False)]
    tree, center, ray = cKDTree(points), np.concatenate(centers), np.concatenate(rays)

    def distance(factor: float) -> float:
        nearest, _ = tree.query(center + factor * depth[:, None] * ray)
        return float(np.median(nearest / (factor * depth)))

    best = 1.0
    for width, count in _ROUNDS:
        factors = best * np.geomspace(1.0 / width, width, count)
        best = float(min(factors, key=distance))
    return ScaleFit(best, distance(1.0), distance(best))


def _sampled(
    shot: Shot, generator: np.random.Generator
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "P 3"], Float[np.ndarray, "P"]]:
    """Camera centre, world ray directions (z = 1 in the camera frame) and z-depths of random pixels of known depth."""
    if shot.depth is None or shot.depth_format is None:
        raise InputError(f"{shot.name} has no depth", "a frame with depth")
    rectification = shot.rectification
    depth = shot.depth_format.z_depth(rectification.sampled(shot.depth, shot.depth_format.read(shot.depth)))
    known = np.flatnonzero(np.isfinite(depth))
    pixels = generator.choice(known, min(_PIXELS, len(known)), replace=False)
    row, column = np.divmod(pixels, rectification.width)
    k = rectification.pinhole
    local = np.stack([(column + 0.5 - k.cx) / k.fx, (row + 0.5 - k.cy) / k.fy, np.ones(len(pixels))], axis=1)
    return shot.camera_to_world[:3, 3], local @ shot.camera_to_world[:3, :3].T, depth.ravel()[pixels].astype(np.float64)
