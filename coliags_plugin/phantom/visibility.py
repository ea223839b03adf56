"""Visibility of wall points in other frames, for seen masks and mesh coverage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.phantom.tracing import Tracer


def seen_from(
    points: Float[np.ndarray, "N 3"],
    cameras_to_world: Sequence[Float[np.ndarray, "4 4"]],
    lens: Lens,
    mask: Bool[np.ndarray, "H W"],
    tracer: Tracer,
) -> Bool[np.ndarray, "N"]:
    """Whether at least one camera sees each point of the wall.

    A camera sees a point that projects to a lit pixel and is not occluded.

    Args:
        points: Points on the wall, world, mm. [N, 3]
        cameras_to_world: Poses, ideally the likeliest to see the points first, as seen points are not tested again.
        lens: Lens of all cameras.
        mask: Lit pixels. [H, W]
        tracer: Ray tracer of the wall.
    """
    seen = np.zeros(len(points), bool)
    open_points = np.arange(len(points))
    for camera_to_world in cameras_to_world:
        if not len(open_points):
            break
        local = (points[open_points] - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
        pixels = lens.project(local)
        with np.errstate(invalid="ignore"):
            column, row = np.floor(pixels).T
            framed = (column >= 0) & (row >= 0) & (column < lens.width) & (row < lens.height) & (local[:, 2] > 0.0)
        inside = np.flatnonzero(framed)
        inside = inside[mask[row[inside].astype(int), column[inside].astype(int)]]
        candidates = open_points[inside]
        visible = tracer.visible(points[candidates], camera_to_world[:3, 3])
        seen[candidates[visible]] = True
        open_points = open_points[~seen[open_points]]
    return seen


def nearest_poses_first(
    camera_to_world: Float[np.ndarray, "4 4"], others: Sequence[Float[np.ndarray, "4 4"]]
) -> list[Float[np.ndarray, "4 4"]]:
    """Other poses, sorted by distance and viewing angle (1 mm counts like 1 degree)."""
    stack = np.stack(others)
    apart = np.linalg.norm(stack[:, :3, 3] - camera_to_world[:3, 3], axis=1)
    rotated = np.degrees(np.arccos(np.clip(stack[:, :3, 2] @ camera_to_world[:3, 2], -1.0, 1.0)))
    return [others[index] for index in np.argsort(apart + rotated, kind="stable")]
