"""Pictures of missed regions: the recorded frame from which one would have had to look further."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from coliags_plugin.surface.coverage.levels import Level
from coliags_plugin.surface.coverage.measure import Coverage, MissedRegion
from coliags_plugin.surface.coverage.views import CoverageView

#: Widest picture, px, and how strongly the region covers the image.
_WIDTH, _OPACITY = 480, 0.55


def region_picture(coverage: Coverage, region: MissedRegion, view: CoverageView) -> UInt8[np.ndarray, "H W 3"] | None:
    """The recorded frame nearest to a region, with the region drawn over it where it lies, hidden or not.

    Args:
        coverage: The measurement.
        region: One of its regions.
        view: The frame, that of ``region.nearest``.

    Returns:
        RGB; None where the recording has no images. [H, W, 3]
    """
    if view.read_image is None:
        return None
    image = view.read_image()
    scale = min(1.0, _WIDTH / image.shape[1])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    corners = coverage.mesh.triangles[region.triangles]
    used, corners = np.unique(corners, return_inverse=True)
    local = (coverage.mesh.vertices[used] - view.center) @ view.camera_to_world[:3, :3]
    pixels = view.lens.project(local) * scale
    placed = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e4).all(axis=1)
    corners = corners.reshape(-1, 3)
    drawn = corners[placed[corners].all(axis=1)]
    painted = image.copy()
    for triangle in np.rint(pixels[drawn]).astype(np.int32):
        cv2.fillConvexPoly(painted, triangle, Level.UNSEEN.color)
    return np.asarray(cv2.addWeighted(painted, _OPACITY, image, 1.0 - _OPACITY, 0.0))
