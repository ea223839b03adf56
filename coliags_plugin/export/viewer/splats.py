"""Gaussians as the browser takes them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.export.splats.cloud import SplatCloud

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

    Args:
        splats: Those of the scene.
    """
    if not len(splats):
        return 1.0
    sigma = float(np.median(np.linalg.norm(splats.scales, axis=1) / 3.0**0.5))
    return 2.0 ** round(math.log2(sigma / _MEDIAN_SIGMA)) if sigma > 0.0 else 1.0


def on_wire(splats: SplatCloud, unit: float) -> dict[str, Any]:
    """Arguments of viser's ``add_gaussian_splats`` and ``set_gaussians``.

    SplatCloud too large for half precision are made as large as it allows, round ones and flat ones alike.

    Args:
        splats: In scene units.
        unit: See :func:`wire_unit`.
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
