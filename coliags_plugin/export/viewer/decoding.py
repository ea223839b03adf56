"""Gaussians of a run for the view of a browser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from coliags_plugin.contracts import GaussianField, gaussians_under
from coliags_plugin.core.cameras import Camera
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.export.viewer.splats import shown
from coliags_plugin.lighting.lamps import HeldLight

#: How much wider than the view, on every side, Gaussians are decoded, so that a small turn shows no gap.
MARGIN = 1.25


class ViewDecoder:
    """Decodes a field for a view, and takes what lies beside it from other Gaussians.

    A field yields the Gaussians that a camera sees; without the others, a turn of the head would show nothing until
    the next decoding.

    Args:
        field: Of the run.
        beside: Gaussians of the whole scene, of which those outside the view are shown.
        device: Of the field.
    """

    def __init__(self, field: GaussianField, beside: SplatCloud, device: torch.device) -> None:
        self.beside = beside
        self._field = field
        self._device = device

    @torch.no_grad()
    def of(self, camera: Camera, light: HeldLight | None = None) -> SplatCloud:
        """Gaussians with their colours, and, of anchor methods, their shapes, as this camera sees them.

        Args:
            camera: View of the browser.
            light: What lights them; None: the lamp on the camera.
        """
        wide = widened(camera).to(self._device)
        seen = shown(gaussians_under(self._field, wide, light))
        return seen.concat(self.beside.part(~in_view(self.beside.means, wide)))


def widened(camera: Camera) -> Camera:
    """The camera with a field of view wider by :data:`MARGIN`, tangents compared."""
    return replace(camera, fx=camera.fx / MARGIN, fy=camera.fy / MARGIN)


def in_view(points: Float[np.ndarray, "N 3"], camera: Camera) -> Bool[np.ndarray, "N"]:
    """Whether points are in front of a camera and within its image. [N]

    Args:
        points: World frame, scene units. [N, 3]
        camera: The camera.
    """
    _, inside = camera.to("cpu", torch.float64).sees(torch.as_tensor(points, dtype=torch.float64))
    return np.asarray(inside.numpy())
