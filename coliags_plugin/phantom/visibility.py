"""What other frames saw: masks for test views, and flags for the mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.lenses.models import Lens
from coliags_plugin.phantom.tracing import Tracer


def seen_from(
    points: Float[np.ndarray, "N 3"],
    cameras_to_world: Sequence[Float[np.ndarray, "4 4"]],
    lens: Lens,
    mask: Bool[np.ndarray, "H W"],
    tracer: Tracer,
) -> Bool[np.ndarray, "N"]:
    """Whether at least one camera sees each point of the wall.

    A camera sees a point that falls on a lit pixel with nothing standing between.

    Args:
        points: On the wall, world, mm. [N, 3]
        cameras_to_world: Poses; the likeliest to see the points first, as a point once seen is done with.
        lens: Of all of them.
        mask: Lit pixels. [H, W]
        tracer: The wall.
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


def likeliest_first(
    camera_to_world: Float[np.ndarray, "4 4"], others: Sequence[Float[np.ndarray, "4 4"]]
) -> list[Float[np.ndarray, "4 4"]]:
    """Other poses, those first that stand near and look the same way (1 mm counts like 1 degree)."""
    stack = np.stack(others)
    apart = np.linalg.norm(stack[:, :3, 3] - camera_to_world[:3, 3], axis=1)
    turned = np.degrees(np.arccos(np.clip(stack[:, :3, 2] @ camera_to_world[:3, 2], -1.0, 1.0)))
    return [others[index] for index in np.argsort(apart + turned, kind="stable")]
