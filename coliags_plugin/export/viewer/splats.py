"""Gaussians as the browser takes them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.rotations import rotation_matrices
from coliags_plugin.outputs.image_files import as_array, eight_bit

#: Bytes of one splat on the wire: centre float32 x 3, unused, covariance float16 x 6, RGBA.
BYTES_PER_SPLAT = 32
#: Largest entry of a covariance: the largest of half precision is 65504.
_LARGEST_COVARIANCE = 6.0e4
#: Median standard deviation of the splats in the units that covariances are sent in.
_MEDIAN_SIGMA = 0.125


@dataclass(frozen=True)
class Splats:
    """Gaussians of one light and view, or of none in particular.

    Attributes:
        centers: Scene units. [N, 3]
        covariances: Scene units squared. [N, 3, 3]
        colors: RGB. [N, 3]
        opacities: In (0, 1]. [N]
    """

    centers: Float[np.ndarray, "N 3"]
    covariances: Float[np.ndarray, "N 3 3"]
    colors: UInt8[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, "N"]

    def __len__(self) -> int:
        return len(self.centers)

    @classmethod
    def of(cls, gaussians: Gaussians) -> Splats:
        """The splats of Gaussians; those with a number that is not finite are left out."""
        with torch.no_grad():
            axes = (
                rotation_matrices(gaussians.quats_wxyz)[:, :, : gaussians.scales.shape[1]] * gaussians.scales[:, None]
            )
            made = cls(
                as_array(gaussians.means.float()),
                as_array((axes @ axes.transpose(1, 2)).float()),
                as_array(eight_bit(gaussians.colors)),
                as_array(gaussians.opacities.float()),
            )
        finite = np.isfinite(made.centers).all(1) & np.isfinite(made.covariances).all((1, 2))
        return made.part(finite & np.isfinite(made.opacities))

    def part(self, kept: Bool[np.ndarray, "N"]) -> Splats:
        """Some of them.

        Args:
            kept: True for those to keep. [N]
        """
        if kept.all():
            return self
        return Splats(self.centers[kept], self.covariances[kept], self.colors[kept], self.opacities[kept])

    def and_also(self, others: Splats) -> Splats:
        """These and others."""
        return Splats(
            np.concatenate([self.centers, others.centers]),
            np.concatenate([self.covariances, others.covariances]),
            np.concatenate([self.colors, others.colors]),
            np.concatenate([self.opacities, others.opacities]),
        )


def wire_unit(splats: Splats) -> float:
    """Length, in scene units, that centres and covariances are sent in multiples of: a power of two.

    The browser holds covariances in half precision. In this unit those of the median splat are well within its range,
    whatever the scene's unit of length; the unit is undone by the scale of the scene node, so that positions, cameras
    and meshes stay in scene units (mm).

    Args:
        splats: Those of the scene.
    """
    if not len(splats):
        return 1.0
    sigma = float(np.median(np.sqrt(np.trace(splats.covariances, axis1=1, axis2=2) / 3.0)))
    return 2.0 ** round(math.log2(sigma / _MEDIAN_SIGMA)) if sigma > 0.0 else 1.0


def on_wire(splats: Splats, unit: float) -> dict[str, Any]:
    """Arguments of viser's ``add_gaussian_splats`` and ``set_gaussians``.

    Splats too large for half precision are made as large as it allows, round ones and flat ones alike.

    Args:
        splats: In scene units.
        unit: See :func:`wire_unit`.
    """
    covariances = splats.covariances / np.float32(unit * unit)
    largest = np.abs(covariances).max(axis=(1, 2), initial=0.0)
    covariances *= np.minimum(1.0, _LARGEST_COVARIANCE / np.maximum(largest, 1.0))[:, None, None]
    return {
        "centers": splats.centers / np.float32(unit),
        "covariances": covariances,
        "rgbs": splats.colors,
        "opacities": splats.opacities[:, None],
    }
