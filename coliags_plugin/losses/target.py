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


class EstimatedDepthSettings(LossSettings):
    """Options of the loss against estimated depth."""

    depth: DepthKind = "depth_accumulated"  # rendered depth that is compared; depth_median has no gradient
    floor: float = Field(default=0.1, ge=0.0, le=1.0)  # weight of a pixel whose confidence is lower than this
    # Huber threshold of the relative difference: smaller ones are squared and divided by twice this
    delta: float = Field(default=0.05, gt=0.0)


class EstimatedDepthLoss(Loss[EstimatedDepthSettings]):
    """Mean of max(c, floor) h(|D - z| / z) over the valid pixels of known depth z of confidence c.

    h is Huber's function with slope 1 beyond ``delta`` (docs/methods.md 4.6). Relative to z, it needs no unit of
    length. Divided by the number of pixels, not by the sum of weights, so that a frame of nothing but prior depth
    guides weakly, too. Depth without confidence counts as certain.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"depth"})

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where no valid pixel has a depth."""
        depth, has_depth = _known_depth(step.target)
        has_depth = has_depth & (depth > 0)
        rendered, options = step.output[self.settings.depth], self.settings
        estimate = torch.where(has_depth, depth, 1.0).to(rendered.dtype)
        rendered, has_depth = _where_drawn(rendered, has_depth, options.depth)
        relative = (zero_outside(rendered - estimate, has_depth) / estimate).abs()
        penalty = functional.smooth_l1_loss(relative, torch.zeros_like(relative), reduction="none", beta=options.delta)
        if step.target.depth_confidence is not None:
            penalty = penalty * step.target.depth_confidence.to(penalty.dtype).clamp_min(options.floor)
        return masked_mean(penalty, has_depth)


class SparseDepthSettings(LossSettings):
    """Options of the sparse depth loss."""

    depth: DepthKind = "depth_expected"  # rendered depth that is compared; depth_median has no gradient
    relative: bool = False  # differences are divided by the known depth, so that the weight needs no unit of length
    # what a point adds at most, of the differences' unit: x becomes bound (1 - exp(-x / bound)), whose slope falls from
    # 1 to 0, so that outliers hardly pull; null: x itself
    bound: float | None = Field(default=None, gt=0.0)


class SparseDepthLoss(Loss[SparseDepthSettings]):
    """Mean |D(p) - z|, or |D(p) - z| / z, over the points p of a frame whose z-depth is known (docs/methods.md 4.5).

    After DS-NeRF (Deng et al., "Depth-supervised NeRF: Fewer Views and Faster Training for Free", CVPR 2022). D is
    interpolated bilinearly at a point, with border pixels replicated. A point is used if all interpolated pixels are
    valid and have alpha > 0.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"sparse_depth"})
    whole_image: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, scene units unless ``relative``; 0, still part of the graph, if no point is used."""
        rendered, points = step.output[self.settings.depth], step.target.sparse_depth
        if points is None or not len(points.depth):
            return rendered.reshape(-1)[:0].sum()
        drawn = (step.output.alpha > 0) & step.target.valid & torch.isfinite(rendered)
        rendered, drawn = _where_drawn(rendered, drawn, self.settings.depth)
        sampled, counts = interpolated(rendered, drawn, points.pixels)
        truth = points.depth.to(rendered.dtype)
        if self.settings.relative:
            counts = counts & (truth > 0)
        difference = torch.where(counts, sampled - truth, 0.0).abs()
        if self.settings.relative:
            difference = difference / torch.where(counts, truth, 1.0)
        if self.settings.bound is not None:
            difference = -self.settings.bound * torch.expm1(-difference / self.settings.bound)
        return difference.sum() / counts.sum().clamp_min(1)


def _known_depth(target: Target) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """The z-depth to compare with, and where it is known and valid."""
    if target.depth is None:
        raise InputError(
            f"frame '{target.name}' has no depth",
            "depth for every training frame, since the losses include one of depth",
            "Remove that term, for instance with `losses.depth=null`",
        )
    return target.depth, torch.isfinite(target.depth) & target.valid


def _where_drawn(
    rendered: Float[Tensor, "H W"], usable: Bool[Tensor, "H W"], kind: str
) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Rendered depth, of inverse depth the reciprocal, and the usable pixels that have one."""
    if kind != "inverse_depth_accumulated":
        return rendered, usable
    usable = usable & (rendered > 0)
    return _reciprocal(rendered, usable, 1.0), usable


def _reciprocal(values: Float[Tensor, "H W"], where: Bool[Tensor, "H W"], otherwise: float) -> Float[Tensor, "H W"]:
    """1/E; both operands are masked so that no gradient becomes NaN."""
    return torch.where(where, 1.0 / torch.where(where, values, 1.0), otherwise)
