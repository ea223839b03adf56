"""Photometric losses of the rendered against the ground-truth image: L1, mean square and D-SSIM."""

from __future__ import annotations

from typing import ClassVar, Literal

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.masked import masked_mean, zero_outside
from coliags_plugin.core.scenes import Target
from coliags_plugin.core.ssim import ssim_map


class L1Loss(Loss):
    """Mean absolute difference over valid pixels and channels (the paper's L_1; docs/methods.md 4.1)."""

    Settings: ClassVar[type[LossSettings]] = LossSettings

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, in units of full scale; 0 where no pixel is valid."""
        return masked_mean(_difference(step.output.rgb, step.target).abs(), step.target.mask)


class MSESettings(LossSettings):
    """Options of the squared difference."""

    image: Literal["rgb", "rgb_coarse"] = Field(
        default="rgb", description="Which rendered image is compared; rgb_coarse is not shaded by view modules."
    )


class MSELoss(Loss[MSESettings]):
    """Mean squared difference over valid pixels and channels, as of NeRF."""

    Settings: ClassVar[type[LossSettings]] = MSESettings

    @property
    def wants(self) -> frozenset[str]:
        """The coarse image, if that is compared."""
        return frozenset({self.settings.image} - {"rgb"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, in units of full scale squared; 0 where no pixel is valid."""
        return masked_mean(_difference(step.output[self.settings.image], step.target).square(), step.target.mask)


class DSSIMLoss(Loss):
    """1 - SSIM over valid pixels (the paper's L_D-SSIM; docs/methods.md 2.4, 4.1).

    Ignored pixels do not enter the windows either, see :func:`coliags_plugin.core.ssim.ssim_map`.
    """

    Settings: ClassVar[type[LossSettings]] = LossSettings
    whole_image: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (equal) to 2; 0 where no pixel is valid."""
        rgb, mask = step.output.rgb, step.target.mask
        return masked_mean(1.0 - ssim_map(rgb, step.target.rgb.to(rgb.dtype), mask), mask)


def _difference(rgb: Float[Tensor, "H W 3"], target: Target) -> Float[Tensor, "H W 3"]:
    """Rendered minus true colours; 0 outside the mask."""
    return zero_outside(rgb, target.mask) - zero_outside(target.rgb.to(rgb.dtype), target.mask)
