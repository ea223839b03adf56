"""Regularization losses of 2D Gaussian Splatting: consistency of normals with depth, and depth distortion."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.masked import masked_mean, zero_outside


class NormalConsistencySettings(LossSettings):
    """Options of the consistency of normals with depth."""

    depth: Literal["depth_expected", "depth_median"] = "depth_expected"  # rendered depth that normals are computed from


class NormalConsistencyLoss(Loss[NormalConsistencySettings]):
    """Mean 1 - alpha <N, n> over the valid pixels, without gradient in alpha.

    N is the output ``normals`` and n the normal of the rendered depth map, 0 at the image border and next to pixels
    that are ignored or where nothing was drawn; such pixels enter as 1 (docs/rivals/2dgs.md).
    """

    Settings: ClassVar[type[LossSettings]] = NormalConsistencySettings
    whole_image: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """Rendered normals, and the depth."""
        return frozenset({"normals", self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (consistent and opaque) to 2.

        Raises:
            InputError: The output is of pixels of several cameras.
        """
        output, mask = step.output, step.target.mask
        if output.camera is None:
            raise InputError("normals of single pixels", "whole images", "Set --set sampler=frames")
        depth = output[self.settings.depth]
        known = depth > 0 if mask is None else (depth > 0) & mask
        of_depth = depth_normals(depth, output.camera, known) * zero_outside(output.alpha.detach(), mask)[..., None]
        return masked_mean(1.0 - (zero_outside(output["normals"], mask) * of_depth).sum(-1), mask)


class DistortionLoss(Loss):
    """Mean of the output ``distortion`` over the valid pixels: draws the surfels along a ray together.

    Depths enter as m = far / (far - near) (1 - near / z) in [0, 1], so the weight depends on the renderer's
    ``near_plane`` and on the unit of length (docs/rivals/2dgs.md).
    """

    Settings: ClassVar[type[LossSettings]] = LossSettings

    @property
    def wants(self) -> frozenset[str]:
        """The distortion, which renderers have of surfels."""
        return frozenset({"distortion"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term."""
        return masked_mean(step.output["distortion"], step.target.mask)


def depth_normals(
    depth: Float[Tensor, "H W"], camera: Camera, known: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W 3"]:
    """Unit normals in camera axes, facing the camera: cross products of central differences of unprojected pixels.

    0 at the border, and where a neighbour above, below, to the left or to the right is unknown. Differentiable in the
    depth; values at unknown pixels have no influence, not even NaN.

    Args:
        depth: z-depth, scene units. [H, W]
        camera: Whose pixels these are.
        known: Where the depth is usable; None: everywhere. [H, W]
    """
    height, width = depth.shape
    if height < 3 or width < 3:
        return depth.new_zeros(height, width, 3)
    # Without a pose, points are in camera axes.
    local = replace(camera, camera_to_world=torch.eye(4, dtype=depth.dtype, device=depth.device))
    points = local.unproject(zero_outside(depth, known))
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    if known is not None:
        normals = zero_outside(normals, known[2:, 1:-1] & known[:-2, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2])
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))
