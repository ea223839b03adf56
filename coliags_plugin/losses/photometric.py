"""Photometric losses of the rendered against the ground-truth image: L1, mean square and D-SSIM, robust if asked."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.scenes import Target
from coliags_plugin.core.ssim import ssim_map
from coliags_plugin.core.tensors import masked_mean, weighted_mean, zero_outside


class PhotometricSettings(LossSettings):
    """Options of the losses between images that can leave out what is not the wall."""

    # multiple of the frame's median residual above which pixels lose weight; null: all count alike
    outliers: float | None = Field(default=None, gt=0.0)
    outliers_from: int = Field(default=2000, ge=0)  # step after which they do; scales with the run


class PhotometricLoss(Loss[PhotometricSettings]):
    """Weighted mean over the valid pixels and channels of a difference between images."""

    def mean(self, values: Float[Tensor, "H W 3"], step: TrainingStep) -> Float[Tensor, ""]:
        """Mean of the values, weighted by :func:`wall_weights` once they count."""
        settings, target = self.settings, step.target
        if settings.outliers is None or step.step <= step.schedule.at(settings.outliers_from):
            return masked_mean(values, target.mask)
        weights = wall_weights(_difference(step.output.rgb, target), target.valid, settings.outliers)
        return weighted_mean(values.mean(-1), target.valid, weights)


class L1Loss(PhotometricLoss):
    """Mean absolute difference over valid pixels and channels (the paper's L_1; docs/methods.md 4.1)."""

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, in units of full scale; 0 where no pixel is valid."""
        return self.mean(_difference(step.output.rgb, step.target).abs(), step)


class MSESettings(LossSettings):
    """Options of the squared difference."""

    image: Literal["rgb", "rgb_coarse"] = "rgb"  # which is compared; rgb_coarse is not shaded by view modules


class MSELoss(Loss[MSESettings]):
    """Mean squared difference over valid pixels and channels, as of NeRF."""

    @property
    def wants(self) -> frozenset[str]:
        """The coarse image, if that is compared."""
        return frozenset({self.settings.image} - {"rgb"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, in units of full scale squared; 0 where no pixel is valid."""
        return masked_mean(_difference(step.output[self.settings.image], step.target).square(), step.target.mask)


class DSSIMLoss(PhotometricLoss):
    """1 - SSIM over valid pixels (the paper's L_D-SSIM; docs/methods.md 2.4, 4.1).

    Ignored pixels do not enter the windows either, see :func:`coliags_plugin.core.ssim.ssim_map`.
    """

    whole_image: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (equal) to 2; 0 where no pixel is valid."""
        rgb = step.output.rgb
        return self.mean(1.0 - ssim_map(rgb, step.target.rgb.to(rgb.dtype), step.target.mask), step)


@torch.no_grad()
def wall_weights(
    difference: Float[Tensor, "H W 3"], valid: Bool[Tensor, "H W"], outliers: float
) -> Float[Tensor, "H W"]:
    """Weight of every pixel by how well the rendering explains it, in (0, 1] (docs/methods.md 4.11).

    With e the mean absolute difference in 5x5 pixels, and m its median over the valid pixels: 1 up to ``outliers`` m,
    beyond it the square of ``outliers`` m / e. The rendering is what the frames agree on, so that a tool, which other
    frames do not show there, has large e.
    """
    error = difference.abs().mean(-1)[None, None]
    inside = valid.to(error.dtype)[None, None]
    near, counted = (functional.avg_pool2d(values, 5, 1, 2) for values in (error * inside, inside))
    smooth = (near / counted.clamp_min(1e-6))[0, 0]
    # NaN, where no pixel is valid.
    median = torch.where(valid, smooth, torch.nan).flatten().nanmedian(0).values
    limit = outliers * median.clamp_min(1.0 / 255.0)
    return torch.where(valid.any(), (limit / smooth.clamp_min(1e-6)).clamp_max(1.0).square(), 1.0)


def _difference(rgb: Float[Tensor, "H W 3"], target: Target) -> Float[Tensor, "H W 3"]:
    """Rendered minus true colours; 0 outside the mask."""
    return zero_outside(rgb, target.mask) - zero_outside(target.rgb.to(rgb.dtype), target.mask)
