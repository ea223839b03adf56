"""Image quality metrics: PSNR, PSNR with a fitted gain, and SSIM."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.ssim import ssim


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
