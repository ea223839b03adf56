"""Do depth and points agree in scale? Surfaces seen from several places tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.recording import Shot

#: Frames and pixels of each that are looked at, and points they are compared with, at most.
_FRAMES, _PIXELS, _POINTS = 6, 100, 50_000
#: Factors tried: from a third to three times, then ever finer around the best.
_ROUNDS = ((3.0, 31), (1.08, 17), (1.01, 11))


@dataclass(frozen=True)
class ScaleFit:
    """How far back-projected depth is from points of the same surface.

    Attributes:
        factor: Depth times this lies closest to the points.
        distance: Median distance of back-projected pixels from their nearest point, as a share of their z-depth,
            with depth as it is.
        distance_at_best: The same with depth times ``factor``.
    """

    factor: float
    distance: float
    distance_at_best: float

    @property
    def disagrees(self) -> bool:
        """Whether depth times another factor fits far better: by more than 5 %, at less than half of the distance."""
        return abs(self.factor - 1.0) > 0.05 and self.distance_at_best < 0.5 * self.distance


def fit_scale(shots: Sequence[Shot], points: Float[np.ndarray, "N 3"]) -> ScaleFit | None:
    """Compare the depth of a few frames, as stored, with points of the surface.

    Points need only lie on the surface; which of them belongs to which pixel is not known. So each pixel is compared
    with the point nearest to where its depth puts it, and the scale is right that brings pixels closest to points.

    Args:
        shots: Frames, of which some may have depth; pinhole images.
        points: World of the poses. [N, 3]

    Returns:
        The fit; None where there is no depth or no points.

    Raises:
        InputError: A depth file cannot be read.
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
    """Some pixels of known depth: the camera's centre, world directions with z = 1 in the camera, z-depths."""
    if shot.depth is None or shot.depth_format is None:
        raise InputError(f"{shot.name} has no depth", "a frame with depth")
    rectification = shot.rectification
    depth = shot.depth_format.z_depth(
        rectification.nearest(rectification.checked(shot.depth, shot.depth_format.read(shot.depth)))
    )
    known = np.flatnonzero(np.isfinite(depth))
    pixels = generator.choice(known, min(_PIXELS, len(known)), replace=False)
    row, column = np.divmod(pixels, rectification.width)
    fx, fy, cx, cy = rectification.pinhole
    local = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(len(pixels))], axis=1)
    return shot.camera_to_world[:3, 3], local @ shot.camera_to_world[:3, :3].T, depth.ravel()[pixels].astype(np.float64)
