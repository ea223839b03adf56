"""Gaussians of a run for the view of a browser, and as the browser takes them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from coliags_plugin.contracts import GaussianField, gaussians_under
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.export.splats.cloud import SplatCloud
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
    the next decoding. ``scale``: length of a scene unit in that of the field.
    """

    def __init__(self, field: GaussianField, beside: SplatCloud, device: torch.device, scale: float = 1.0) -> None:
        self.beside, self._scale = beside, scale
        self._field = field
        self._device = device

    @torch.no_grad()
    def of(self, camera: Camera, light: HeldLight | None = None) -> SplatCloud:
        """Gaussians with their colours, and, of anchor methods, their shapes, as this camera sees them.

        They are in this light, or in that of the lamp on the camera.
        """
        wide = widened(camera).to(self._device)
        light = None if light is None else light.scaled(self._scale)
        seen = shown(gaussians_under(self._field, wide.scaled(self._scale), light)).scaled(1.0 / self._scale)
        return seen.concat(self.beside.part(~in_view(self.beside.means, wide)))


def widened(camera: Camera) -> Camera:
    """The camera with a field of view wider by :data:`MARGIN`, tangents compared."""
    return replace(camera, fx=camera.fx / MARGIN, fy=camera.fy / MARGIN)


def in_view(points: Float[np.ndarray, "N 3"], camera: Camera) -> Bool[np.ndarray, "N"]:
    """Whether points, in the world frame, are in front of a camera and within its image. [N]"""
    _, inside = camera.to("cpu", torch.float64).sees(torch.as_tensor(points, dtype=torch.float64))
    return np.asarray(inside.numpy())


def most_visible(splats: SplatCloud, count: int) -> SplatCloud:
    """At most so many splats: those that cover most, by opacity times area seen from the front, in their order."""
    covers = splats.opacities * np.sort(splats.scales, axis=1)[:, 1:].prod(axis=1)
    kept = np.zeros(len(splats), bool)
    kept[np.argsort(-covers, kind="stable")[:count]] = True
    return splats.part(kept)
