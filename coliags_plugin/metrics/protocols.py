"""Evaluation protocols: all choices that define a metric, under one name and version.

A protocol's name and version are written into every result; results whose name or version differ are not comparable.
``docs/protocols.md`` sets the protocols side by side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Comparison, Protocol
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.tensors import interpolated

MetricTable = Mapping[str, tuple[str, Mapping[str, Any]]]

# The splatting papers' variant: VGG fed [0, 1] unmapped (docs/methods.md 2.4).
_LPIPS_OF_THE_PAPERS = {"net": "vgg", "input_range": "zero-one"}

_DEPTH_METRICS: MetricTable = {
    name: (name, {})
    for name in ("depth_mse", "depth_mse_inner", "depth_median_error", "depth_rmse", "depth_mae", "depth_abs_rel")
}


class PaperProtocol(Protocol):
    """The metrics as the paper defines them, on float images and valid pixels.

    Depth is Eq. 2's sum of w z; it is scored where the ground truth is known.
    """

    name: ClassVar[str] = "paper"
    version: ClassVar[int] = 1
    description: ClassVar[str] = (
        "Float images and depth_accumulated (sum w z), no quantisation; masked pixels and unknown depths are "
        "ignored. SSIM 11x11 sigma 1.5; LPIPS VGG fed [0, 1]."
    )
    #: The rendered depth that is scored.
    depth: ClassVar[str] = "depth_accumulated"
    wants: ClassVar[frozenset[str]] = frozenset({depth})
    metrics: ClassVar[MetricTable] = {
        "psnr": ("psnr", {}),
        "ssim": ("ssim", {}),
        "lpips": ("lpips", _LPIPS_OF_THE_PAPERS),
        # Not in the paper: its weights are small and easier to obtain than VGG's.
        "lpips_squeeze": ("lpips", {"net": "squeeze", "input_range": "zero-one"}),
        **_DEPTH_METRICS,
    }
    optional_metrics: ClassVar[MetricTable] = {
        "psnr_gain_fitted": ("psnr_gain_fitted", {}),
        "sparse_depth_median": ("sparse_depth", {"quantile": 0.5}),
        "sparse_depth_p90": ("sparse_depth", {"quantile": 0.9}),
    }

    def compare(self, output: RenderOutput, frame: Frame) -> Comparison:
        """Pair the rendered image, clamped to [0, 1], and the unchanged rendered depth with the frame."""
        depth = output[self.depth].detach()
        image = Comparison(rgb=output.rgb.detach().clamp(0.0, 1.0), true_rgb=frame.rgb, valid=frame.valid)
        if (points := frame.sparse_depth) is not None:
            drawn = (output.alpha.detach() > 0) & torch.isfinite(depth) & frame.valid
            sampled, usable = interpolated(depth, drawn, points.pixels)
            usable = usable & (points.depth > 0)
            image = replace(image, point_depth=sampled[usable], true_point_depth=points.depth[usable])
        if (truth := frame.true_depth) is None:
            return replace(image, estimated=frame.depth_confidence is not None)
        return replace(image, depth=depth, true_depth=truth, depth_valid=torch.isfinite(truth) & frame.valid)


class ExpectedDepthProtocol(PaperProtocol):
    """The paper's depth metrics, of the expected depth: the weighted mean z, 0 where nothing was drawn."""

    name: ClassVar[str] = "expected-depth"
    description: ClassVar[str] = (
        "The depth metrics of the protocol paper, of depth_expected (sum w z / sum w); and PSNR, SSIM."
    )
    depth: ClassVar[str] = "depth_expected"
    wants: ClassVar[frozenset[str]] = frozenset({depth})
    metrics: ClassVar[MetricTable] = {"psnr": ("psnr", {}), "ssim": ("ssim", {}), **_DEPTH_METRICS}


class MedianDepthProtocol(ExpectedDepthProtocol):
    """The paper's depth metrics, of the median depth: z where half of the light is stopped, 0 where it never is."""

    name: ClassVar[str] = "median-depth"
    description: ClassVar[str] = (
        "The depth metrics of the protocol paper, of depth_median (z where transmittance falls to 1/2); and PSNR, SSIM."
    )
    depth: ClassVar[str] = "depth_median"
    wants: ClassVar[frozenset[str]] = frozenset({depth})


class AuthorsCodeProtocol(Protocol):
    """The metrics as the authors' released code computes them (docs/methods.md 5.4): from PNG files, without a mask.

    The rendered depth is 1 / (sum w/z) through 16 bit over 150 mm; where nothing was drawn that is infinite, which the
    cast turns into 0. The true depth goes through 16 bit over 100 mm with unknown pixels at 0 and the sensor's clipped
    ones at its limit, against which the rendered ones are scored. Both wrap around beyond their full scale.
    """

    name: ClassVar[str] = "authors-code"
    version: ClassVar[int] = 2
    description: ClassVar[str] = (
        "8-bit images; depth 1/(sum w/z) as 16 bit over 150 mm against truth as 16 bit over 100 mm, both wrapping "
        "around; no mask, empty pixels and unknown true depth count as 0, clipped true depth as its "
        "limit. SSIM 11x11 sigma 1.5; LPIPS VGG fed [0, 1]."
    )
    wants: ClassVar[frozenset[str]] = frozenset({"inverse_depth_accumulated"})
    metrics: ClassVar[MetricTable] = {
        "psnr": ("psnr", {}),
        "ssim": ("ssim", {}),
        "lpips": ("lpips", _LPIPS_OF_THE_PAPERS),
        "depth_mse": ("depth_mse", {}),
    }

    #: Depths of level 65535 in the files of rendered and true depth, mm.
    rendered_full_scale: ClassVar[float] = 150.0
    true_full_scale: ClassVar[float] = 100.0

    def compare(self, output: RenderOutput, frame: Frame) -> Comparison:
        """Rendered and true image and depth as read back from the files; every pixel counts."""
        everywhere = torch.ones_like(frame.valid)
        image = Comparison(rgb=through_8_bit(output.rgb.detach()), true_rgb=through_8_bit(frame.rgb), valid=everywhere)
        if (true_depth := frame.true_depth) is None:
            return replace(image, estimated=frame.depth_confidence is not None)
        rendered = 1.0 / output["inverse_depth_accumulated"].detach()  # infinite where nothing was drawn
        if frame.depth_at_least is not None:
            true_depth = torch.where(torch.isfinite(frame.depth_at_least), frame.depth_at_least, true_depth)
        true_depth = torch.where(torch.isfinite(true_depth), true_depth, 0.0)
        return replace(
            image,
            depth=through_16_bit(rendered, self.rendered_full_scale),
            true_depth=through_16_bit(true_depth, self.true_full_scale),
            depth_valid=everywhere,
        )


_LEVELS = 65535


def through_8_bit(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Image written as 8 bit by torchvision's ``save_image`` (times 255, plus 0.5, clamped, truncated) and read back.

    NaN stays NaN, so that the metrics refuse it.
    """
    return (rgb * 255.0 + 0.5).clamp(0.0, 255.0).floor() / 255.0


def through_16_bit(depth: Float[Tensor, "H W"], full_scale: float) -> Float[Tensor, "H W"]:
    """Depth written as ``(depth / full_scale * 65535).astype(uint16)`` in float32 and read back, mm.

    The cast truncates. It does not clamp: beyond full scale it keeps the lower 16 bits, so 151 mm at a scale of 150 mm
    comes back as 1 mm. That, and 0 for what a 32-bit integer cannot hold (infinity, NaN), is what numpy gives on
    x86-64, where the published values were computed; C leaves both undefined. ``full_scale``: of level 65535, mm.
    """
    levels = (depth.float() / full_scale * _LEVELS).trunc()
    fits = levels.abs() < 2.0**31  # False for NaN
    stored = torch.where(fits, levels, 0.0).to(torch.int64) % (_LEVELS + 1)
    return stored.float() / _LEVELS * full_scale
