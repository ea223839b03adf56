"""Metrics of rendered images and depth maps against the truth: PSNR, SSIM and errors of depth."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.ssim import ssim
from coliags_plugin.core.tensors import depth_steps, dilated


class PSNR(Metric):
    """Peak signal-to-noise ratio, 10 log10(1 / mse), the mse over all channels of the valid pixels together.

    (The authors' in-training report averages one PSNR per channel instead; docs/methods.md 2.4.)
    """

    higher_is_better: ClassVar[bool] = True
    unit: ClassVar[str] = "dB"

    def __call__(self, comparison: Comparison) -> float:
        """PSNR of one frame, dB; unavailable where :func:`require_image` says so, or the images are identical."""
        require_image(comparison)
        difference = comparison.rgb.double() - comparison.true_rgb.double()
        squared_error = difference[comparison.valid].square().mean()
        if squared_error == 0:
            raise UnavailableError("the images are identical, so the PSNR is infinite")
        return float(-10.0 * torch.log10(squared_error))


class GainFittedPSNR(PSNR):
    """PSNR after all colours of the render are multiplied by one factor, that of least squared error.

    It uses the true image: what it is above the PSNR is an error of exposure, not of the model.
    """

    def __call__(self, comparison: Comparison) -> float:
        """PSNR of one frame with its best factor, dB; unavailable where the PSNR is."""
        require_image(comparison)
        rendered, true = (rgb[comparison.valid].double() for rgb in (comparison.rgb, comparison.true_rgb))
        gain = (rendered * true).sum() / rendered.square().sum().clamp_min(1e-12)
        return super().__call__(replace(comparison, rgb=comparison.rgb.double() * gain))


class SSIM(Metric):
    """Structural similarity by :func:`coliags_plugin.core.ssim.ssim`; ignored pixels do not enter the windows."""

    higher_is_better: ClassVar[bool] = True
    unit: ClassVar[str] = ""

    def __call__(self, comparison: Comparison) -> float:
        """SSIM of one frame, at most 1; unavailable where :func:`require_image` says so."""
        require_image(comparison)
        return float(ssim(comparison.rgb.double(), comparison.true_rgb.double(), comparison.valid))


def require_image(comparison: Comparison) -> None:
    """Refuse images without a valid pixel, and rendered ones that are not finite at one (UnavailableError)."""
    if not comparison.valid.any():
        raise UnavailableError("the mask leaves no pixel")
    if broken := (~torch.isfinite(comparison.rgb).all(dim=-1) & comparison.valid).sum():
        raise UnavailableError(f"the rendered image is not finite at {int(broken)} pixels")


class DepthMetric(Metric):
    """Base class of the depth metrics: pixel selection and the reasons for an unavailable value."""

    higher_is_better: ClassVar[bool] = False
    unit: ClassVar[str] = "mm"

    def __call__(self, comparison: Comparison) -> float:
        """The metric of one frame; unavailable without true depth or pixels, or if rendered depth is not finite."""
        rendered, truth, counts = comparison.depth, comparison.true_depth, comparison.depth_valid
        if rendered is None or truth is None or counts is None:
            raise UnavailableError(
                "estimated depth is no truth" if comparison.estimated else "this frame has no ground-truth depth"
            )
        if not counts.any():
            raise UnavailableError("no pixel of this frame has a valid ground-truth depth")
        counts = self.select(truth, counts)
        rendered, truth = rendered[counts].double(), truth[counts].double()
        if broken := (~torch.isfinite(rendered)).sum():
            raise UnavailableError(f"the rendered depth is not finite at {int(broken)} pixels")
        return float(self.error(rendered, truth))

    def select(self, truth: Float[Tensor, "H W"], counts: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
        """Mask of the pixels that enter the metric: all valid ones unless overridden; at least one."""
        return counts

    @abstractmethod
    def error(self, rendered: Float[Tensor, "P"], truth: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """The metric over the selected pixels, whose depths are in mm."""


class DepthMSE(DepthMetric):
    """Mean squared error, the paper's Depth MSE.

    Dominated by the few pixels beside depth steps; read it together with the other depth metrics.
    """

    unit: ClassVar[str] = "mm^2"

    def error(self, rendered: Float[Tensor, "P"], truth: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Mean of (D - D_true)^2, mm^2."""
        return (rendered - truth).square().mean()


class DepthMSEInner(DepthMSE):
    """Mean squared error of the pixels away from depth steps, so without silhouettes."""

    #: (max - min) / min of a 3x3 window of true depth that is a step, and pixels left out on either side of one.
    relative_step: ClassVar[float] = 0.12
    margin: ClassVar[int] = 2

    def select(self, truth: Float[Tensor, "H W"], counts: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
        """Valid pixels further than ``margin`` from any depth step."""
        steps = depth_steps(truth, counts, self.relative_step)
        inner = counts & ~dilated(steps, self.margin)
        if not inner.any():
            raise UnavailableError("all pixels of this frame are near depth steps")
        return inner


class DepthRMSE(DepthMetric):
    """Root of the mean squared error."""

    def error(self, rendered: Float[Tensor, "P"], truth: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Square root of the mean of (D - D_true)^2, mm."""
        return (rendered - truth).square().mean().sqrt()


class DepthMAE(DepthMetric):
    """Mean absolute error."""

    def error(self, rendered: Float[Tensor, "P"], truth: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Mean of |D - D_true|, mm."""
        return (rendered - truth).abs().mean()


class DepthMedianError(DepthMetric):
    """Median absolute error, robust to silhouettes and floaters."""

    def error(self, rendered: Float[Tensor, "P"], truth: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Median of |D - D_true|, the mean of the middle two for an even number of pixels, mm."""
        errors = (rendered - truth).abs().sort().values
        middle = len(errors) // 2
        return errors[middle] if len(errors) % 2 else (errors[middle - 1] + errors[middle]) / 2


class DepthAbsRel(DepthMetric):
    """Mean error relative to the true depth."""

    unit: ClassVar[str] = ""

    def error(self, rendered: Float[Tensor, "P"], truth: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Mean of |D - D_true| / D_true."""
        if (truth <= 0).any():
            raise UnavailableError("a true depth of 0 mm makes the relative error infinite")
        return ((rendered - truth).abs() / truth).mean()


class SparseDepthErrorSettings(Settings):
    """Quantile of the errors."""

    quantile: float = Field(default=0.5, ge=0.0, le=1.0)  # 0.5: the median


class SparseDepthError(Metric[SparseDepthErrorSettings]):
    """A quantile of |D(p) - z| / z over a frame's points p of known depth z, in percent."""

    higher_is_better: ClassVar[bool] = False
    unit: ClassVar[str] = "%"

    def __call__(self, comparison: Comparison) -> float:
        """The metric of one frame; unavailable without points, or if nothing was drawn at any."""
        rendered, true_depth = comparison.point_depth, comparison.true_point_depth
        if rendered is None or true_depth is None:
            raise UnavailableError("this frame has no points of known depth")
        if not len(true_depth):
            raise UnavailableError("nothing was drawn at the points of known depth")
        errors = (rendered.double() - true_depth.double()).abs() / true_depth.double()
        return 100.0 * float(torch.quantile(errors, self.settings.quantile))
