"""Regularization losses of 2D Gaussian Splatting: consistency of normals with depth, and depth distortion."""

from __future__ import annotations

from typing import ClassVar, Literal

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.masked import masked_mean, zero_outside
from coliags_plugin.losses.depth_normals import depth_normals


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
        of_depth = depth_normals(depth, output.camera, known) * output.alpha.detach()[..., None]
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
