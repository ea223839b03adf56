"""Losses against a frame: of the rendered image, and of depth where it is true, estimated or known at single points."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from torch.nn import functional
from typing_extensions import TypeVar

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Target
from coliags_plugin.core.ssim import ssim_map
from coliags_plugin.core.tensors import fixed_uniform, interpolated, masked_mean, weighted_mean, zero_outside


class L1Loss(Loss):
    """Mean absolute difference over valid pixels and channels (the paper's L_1; docs/methods.md 4.1)."""

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, in units of full scale; 0 where no pixel is valid."""
        return masked_mean(_difference(step.output.rgb, step.target).abs(), step.target.mask)


class MSESettings(LossSettings):
    """Options of the squared difference."""

    image: Literal["rgb", "rgb_coarse"] = "rgb"  # which is compared; rgb_coarse is not shaded by view modules


class MSELoss(Loss[MSESettings]):
    """Mean squared difference over valid pixels and channels, as of NeRF."""

    @property
    def wants(self) -> frozenset[str]:
        """``rgb_coarse`` where the coarse image is compared."""
        return frozenset({self.settings.image} - {"rgb"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, in units of full scale squared; 0 where no pixel is valid."""
        return masked_mean(_difference(step.output[self.settings.image], step.target).square(), step.target.mask)


class DSSIMLoss(Loss):
    """1 - SSIM over valid pixels (the paper's L_D-SSIM; docs/methods.md 2.4, 4.1).

    Ignored pixels do not enter the windows either, see :func:`coliags_plugin.core.ssim.ssim_map`.
    """

    whole_image: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (equal) to 2; 0 where no pixel is valid."""
        rgb, mask = step.output.rgb, step.target.mask
        return masked_mean(1.0 - ssim_map(rgb, step.target.rgb.to(rgb.dtype), mask), mask)


def _difference(rgb: Float[Tensor, "H W 3"], target: Target) -> Float[Tensor, "H W 3"]:
    """Rendered minus true colours; 0 outside the mask."""
    return zero_outside(rgb, target.mask) - zero_outside(target.rgb.to(rgb.dtype), target.mask)


#: :data:`coliags_plugin.core.render_output.DEPTH_KINDS` as a literal type; a test compares the two.
DepthKind = Literal["depth_accumulated", "depth_expected", "depth_median", "inverse_depth_accumulated"]


class DepthL1Settings(LossSettings):
    """Options of the L1 depth loss."""

    depth: DepthKind = "depth_accumulated"  # rendered depth that is compared; the paper's D is depth_accumulated
    empty_depth: float = Field(default=100.0, gt=0.0)  # depth of an empty pixel, mm; inverse_depth_accumulated only


class DepthHuberSettings(DepthL1Settings):
    """Options of the Huber depth loss."""

    delta: float = Field(default=0.2, gt=0.0)  # difference at which the loss becomes linear, scene units


#: Settings of a depth loss.
DepthLossT = TypeVar("DepthLossT", bound=DepthL1Settings, default=DepthL1Settings)


class DepthL1Loss(Loss[DepthLossT]):
    """Mean |D - D_true| in mm over the valid pixels of known true depth (the paper's L_depth; docs/methods.md 4.1).

    The paper writes a sum over pixels and the authors' code takes the mean; this is the mean. The authors' code also
    pulls pixels of unknown depth towards 0; here they are ignored. Estimated depth has its confidence as weight.

    For ``inverse_depth_accumulated`` (E = sum w/z, what the authors' code of the paper trains on) D = 1/E where E > 0.
    Where nothing was drawn (E = 0) D is ``empty_depth``, which enters the value but has no gradient.
    """

    Settings: ClassVar[type[LossSettings]] = DepthL1Settings
    needs: ClassVar[frozenset[str]] = frozenset({"depth"})
    trusts_depth: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def penalty(self, differences: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Penalty of each difference in depth: its absolute value, mm."""
        return differences.abs()

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where no valid pixel has a depth that is trusted at all."""
        depth, has_depth = _known_depth(step.target)
        rendered = step.output[self.settings.depth]
        if self.settings.depth == "inverse_depth_accumulated":
            rendered = _reciprocal(rendered, rendered > 0, self.settings.empty_depth)
        truth = depth.to(rendered.dtype)
        penalties = self.penalty(zero_outside(rendered, has_depth) - zero_outside(truth, has_depth))
        return weighted_mean(penalties, has_depth, step.target.depth_confidence)


class DepthHuberLoss(DepthL1Loss[DepthHuberSettings]):
    """Mean Huber loss of the depth: x^2 / 2 for |x| up to ``delta``, beyond it delta (|x| - delta / 2).

    Otherwise as :class:`DepthL1Loss`. Used by Gaussian Pancakes and PR-Endo (docs/rivals/gaussian-pancakes.md).
    """

    def penalty(self, differences: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Huber's function of them, mm squared."""
        zero = torch.zeros_like(differences)
        return functional.huber_loss(differences, zero, reduction="none", delta=self.settings.delta)


class DistanceL1Settings(LossSettings):
    """Options of the distance loss."""

    # rendered depth whose distance is compared: the final or the coarse
    depth: Literal["depth_accumulated", "depth_accumulated_coarse"] = "depth_accumulated"
    unit: Literal["scene", "field"] = "scene"  # unit of the difference: the scene's, mm in metric data, or the field's
    share: float = Field(default=1.0, gt=0.0, le=1.0)  # share of the pixels of each frame that count, drawn once
    seed: int = Field(default=0, ge=0)  # seed of the pixels drawn


class DistanceL1Loss(Loss[DistanceL1Settings]):
    """Mean |t - t_true| over the drawn valid pixels of known depth, t = |r| sum w z = sum w t_i (REIM-NeRF).

    Weighted by the confidence of the depth if it is estimated. |r| is the length of the pixel's ray per z-depth. Which
    pixels are drawn depends on ``seed``, frame and pixel only, so it is the same at every step and in a resumed run.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"depth"})
    trusts_depth: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth, and the lengths of the rays."""
        return frozenset({self.settings.depth, "ray_lengths"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term in ``unit``; 0 where no pixel counts."""
        depth, has_depth = _known_depth(step.target)
        if self.settings.share < 1.0:
            has_depth = has_depth & (fixed_uniform(step.target.ids, self.settings.seed) < self.settings.share)
        rendered = step.output[self.settings.depth]
        difference = zero_outside(rendered, has_depth) - zero_outside(depth.to(rendered.dtype), has_depth)
        error = weighted_mean(difference.abs() * step.output["ray_lengths"], has_depth, step.target.depth_confidence)
        return error / step.model.field.length_unit if self.settings.unit == "field" else error


#: Least weight of a pixel of estimated depth, and the relative difference at which Huber's function becomes linear.
_LEAST_CONFIDENCE, _HUBER = 0.1, 0.05
#: What a single point adds at most, as a relative difference.
_POINT_BOUND = 0.1


class SceneDepthLoss(Loss):
    """Difference from whatever depth a frame has, relative, so that it needs no unit of length (docs/methods.md 4.5).

    D is the accumulated depth, z the frame's, x = |D - z| / z.

    - True depth: the mean of |D - z| over the mean of z, of the valid pixels.
    - Estimated depth: the mean of max(c, 0.1) h(x), c the confidence and h Huber's function with slope 1 beyond 5 %.
      Divided by the number of pixels, not by the sum of weights, so that a frame of nothing but prior depth guides
      weakly, too.
    - Depth at single points: the mean of 0.1 (1 - exp(-x / 0.1)), whose slope falls from 1 to 0: outliers hardly pull.
      D / alpha is interpolated bilinearly at a point, with border pixels replicated; a point counts if all
      interpolated pixels are valid and have alpha > 0 (after DS-NeRF, Deng et al., CVPR 2022).
    - Without any of these it is 0.
    """

    whole_image: ClassVar[bool] = True
    reads_any: ClassVar[frozenset[str]] = frozenset({"depth", "sparse_depth"})

    @property
    def wants(self) -> frozenset[str]:
        """The accumulated depth."""
        return frozenset({"depth_accumulated"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0, still part of the graph, where nothing is to be compared."""
        target, rendered = step.target, step.output["depth_accumulated"]
        if target.depth is None:
            return _difference_at_points(rendered, step.output.alpha, target)
        has_depth = torch.isfinite(target.depth) & target.valid & (target.depth > 0)
        truth = torch.where(has_depth, target.depth, 1.0).to(rendered.dtype)
        differences = zero_outside(rendered - truth, has_depth).abs()
        if target.depth_confidence is None:
            return masked_mean(differences, has_depth) / masked_mean(truth, has_depth).clamp_min(1e-9)
        relative = differences / truth
        robust = functional.smooth_l1_loss(relative, torch.zeros_like(relative), reduction="none", beta=_HUBER)
        return masked_mean(robust * target.depth_confidence.to(robust.dtype).clamp_min(_LEAST_CONFIDENCE), has_depth)


def _difference_at_points(
    rendered: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"], target: Target
) -> Float[Tensor, ""]:
    """Bounded mean relative difference of expected depth from the depths of a frame's points."""
    points = target.sparse_depth
    if points is None or not len(points.depth):
        return rendered.reshape(-1)[:0].sum()
    drawn = (alpha > 0) & target.valid & torch.isfinite(rendered)
    sampled, counts = interpolated(rendered / torch.where(drawn, alpha, 1.0), drawn, points.pixels)
    truth = points.depth.to(rendered.dtype)
    counts = counts & (truth > 0)
    relative = torch.where(counts, sampled - truth, 0.0).abs() / torch.where(counts, truth, 1.0)
    return (-_POINT_BOUND * torch.expm1(-relative / _POINT_BOUND)).sum() / counts.sum().clamp_min(1)


def _known_depth(target: Target) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """The z-depth to compare with, and where it is known and valid."""
    if target.depth is None:
        raise InputError(
            f"frame '{target.name}' has no depth",
            "depth for every training frame, since the losses include one of depth",
            "Remove that term, for instance with `losses.depth=null`",
        )
    return target.depth, torch.isfinite(target.depth) & target.valid


def _reciprocal(values: Float[Tensor, "H W"], where: Bool[Tensor, "H W"], otherwise: float) -> Float[Tensor, "H W"]:
    """1/E; both operands are masked so that no gradient becomes NaN."""
    return torch.where(where, 1.0 / torch.where(where, values, 1.0), otherwise)
