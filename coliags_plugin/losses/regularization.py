"""Losses without truth: of rendered maps and normals, of gains, and of the Gaussians themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.tensors import constant, masked_mean, zero_outside


class OpacityLoss(Loss):
    """Mean of 1 - alpha over the valid pixels: a colon is closed, so that every ray ends on tissue.

    Without it, a dark lumen is matched as well by nothing in front of the black background (docs/methods.md 4.5).
    """

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (opaque) to 1; 0 where no pixel is valid."""
        return masked_mean(1.0 - step.output.alpha, step.target.mask)


class NormalConsistencySettings(LossSettings):
    """Options of the consistency of normals with depth."""

    depth: Literal["depth_expected", "depth_median"] = "depth_expected"  # rendered depth that normals are computed from


class NormalConsistencyLoss(Loss[NormalConsistencySettings]):
    """Mean 1 - alpha <N, n> over the valid pixels, without gradient in alpha.

    N is the output ``normals`` and n the normal of the rendered depth map, 0 at the image border and next to pixels
    that are ignored or where nothing was drawn; such pixels enter as 1 (docs/rivals/2dgs.md).
    """

    whole_image: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """Rendered normals, and the depth."""
        return frozenset({"normals", self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (consistent and opaque) to 2; refuses pixels of several cameras."""
        output, mask = step.output, step.target.mask
        if output.camera is None:
            raise InputError("normals of single pixels", "whole images", "Use `sampler=frames`")
        depth = output[self.settings.depth]
        is_known = depth > 0 if mask is None else (depth > 0) & mask
        of_depth = depth_normals(depth, output.camera, is_known) * zero_outside(output.alpha.detach(), mask)[..., None]
        return masked_mean(1.0 - (zero_outside(output["normals"], mask) * of_depth).sum(-1), mask)


class DistortionLoss(Loss):
    """Mean of the output ``distortion`` over the valid pixels: draws the surfels along a ray together.

    Depths enter as m = far / (far - near) (1 - near / z) in [0, 1], so the weight depends on the renderer's
    ``near_plane`` and on the unit of length (docs/rivals/2dgs.md).
    """

    @property
    def wants(self) -> frozenset[str]:
        """The distortion, which renderers have of surfels."""
        return frozenset({"distortion"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term."""
        return masked_mean(step.output["distortion"], step.target.mask)


class SmoothGainSettings(LossSettings):
    """Options of the loss on gains."""

    module: str = "exposure"  # name of the view module 'gain' in the method config


class SmoothGainLoss(Loss[SmoothGainSettings]):
    """Mean squared curvature of the learned log gain over time, in frames of the video (docs/methods.md 4.7).

    The curvature is the squared change of slope over the distance in which it changes; slopes are those between
    training frames that follow each other. 0 with fewer than three.
    """

    def check(self, model: TrainedModel) -> None:
        """Refuse methods without that module."""
        self._gain_curve(model)

    def _gain_curve(self, model: TrainedModel) -> tuple[Sequence[float], Tensor]:
        module = model.view_modules.get(self.settings.module)
        curve = None if module is None else module.gain_curve
        if curve is None:
            modules = [name for name, module in model.view_modules.items() if module.gain_curve is not None]
            raise InputError(
                f"loss 'smooth-gain' reads the gains of module '{self.settings.module}'",
                f"the name of a module 'gain', one of {', '.join(modules)}" if modules else "a module 'gain'",
                did_you_mean(self.settings.module, modules),
            )
        return curve

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term."""
        times, log_gains = self._gain_curve(step.model)
        if len(log_gains) < 3:
            return log_gains.sum() * 0.0
        gaps = constant(tuple(times), log_gains).diff().clamp_min(1.0)[:, None]
        bends = (log_gains.diff(dim=0) / gaps).diff(dim=0).square()
        return (2.0 * bends / (gaps[1:] + gaps[:-1])).mean()


def depth_normals(depth: Float[Tensor, "H W"], camera: Camera, is_known: Bool[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """Unit normals in camera axes, facing the camera: cross products of central differences of unprojected pixels.

    0 at the border, and where a neighbour above, below, to the left or to the right of the z-depth is unknown.
    Differentiable in the depth; values at unknown pixels have no influence, not even NaN.
    """
    height, width = depth.shape
    if height < 3 or width < 3:
        return depth.new_zeros(height, width, 3)
    # Without a pose, points are in camera axes.
    local = replace(camera, camera_to_world=torch.eye(4, dtype=depth.dtype, device=depth.device))
    points = local.unproject(zero_outside(depth, is_known))
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    beside = is_known[2:, 1:-1] & is_known[:-2, 1:-1] & is_known[1:-1, 2:] & is_known[1:-1, :-2]
    return torch.nn.functional.pad(zero_outside(normals, beside), (0, 0, 1, 1, 1, 1))


def _drawn_channel(step: TrainingStep, channel: str) -> Float[Tensor, "N C"]:
    return step.output.drawn.gaussians.features[channel]


def _refuse_without_channel(model: TrainedModel, channel: str, loss: str) -> None:
    channels = sorted(model.field.feature_channels)
    if channel not in channels:
        raise InputError(
            f"loss '{loss}' reads channel '{channel}' of the Gaussians, and the field has "
            f"{', '.join(channels) or 'none'}",
            "a channel of the field",
            did_you_mean(channel, channels) or "Remove the term, or choose another field, such as lit-gaussians",
        )


class AttributeVarianceSettings(LossSettings):
    """Options of the loss on variances."""

    attribute: str  # feature channel of the field, for instance albedo


class AttributeVarianceLoss(Loss[AttributeVarianceSettings]):
    """Variance of a feature channel over the Gaussians drawn, averaged over its components (docs/rivals/pr-endo.md)."""

    needs_splats: ClassVar[bool] = True

    def check(self, model: TrainedModel) -> None:
        """Refuse fields without this channel."""
        _refuse_without_channel(model, self.settings.attribute, "attribute-variance")

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        values = _drawn_channel(step, self.settings.attribute)
        count = max(len(values), 1)
        return (values - values.sum(0) / count).square().mean(1).sum() / count


class DiffuseFactorLoss(Loss):
    """f(t) times the mean (1 - m)^2 over the Gaussians drawn, m the channel ``diffuse_factor``.

    f falls linearly from 1 at ``from_step`` to 0 at ``until_step``, or at the last step where there is none
    (docs/rivals/pr-endo.md).
    """

    needs_splats: ClassVar[bool] = True

    def check(self, model: TrainedModel) -> None:
        """Refuse fields without diffuse factors."""
        _refuse_without_channel(model, "diffuse_factor", "diffuse-factor")

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        factors = _drawn_channel(step, "diffuse_factor")
        schedule, options = step.schedule, self.settings
        start = schedule.at(options.from_step)
        end = schedule.steps if options.until_step is None else schedule.at(options.until_step)
        share = min(1.0, max(0.0, (end - step.step) / max(end - start, 1)))
        return share * (1.0 - factors).square().sum() / max(factors.numel(), 1)


class ScaleVolumeLoss(Loss):
    """Mean product of the scales of the Gaussians drawn (the paper's L_scale; docs/methods.md 4.1).

    In scene units cubed (mm^3; squared for surfels), so its weight depends on the unit of length (docs/methods.md 4.4).
    """

    needs_splats: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        scales = step.output.drawn.gaussians.scales
        volumes = reduce(torch.mul, scales.unbind(dim=-1))  # the derivative of ``Tensor.prod`` is slower
        return volumes.sum() / max(len(scales), 1)


class AnisotropySettings(LossSettings):
    """Options of the loss on needles."""

    max_ratio: float = Field(default=4.0, ge=1)  # ratio of the two largest scales that costs nothing


class AnisotropyLoss(Loss[AnisotropySettings]):
    """Mean of log(r / ``max_ratio``) where positive, r the ratio of the two largest scales of every Gaussian drawn.

    Flat Gaussians cost nothing. Needles do: from the training views most of them look right, from others they stick out
    (docs/methods.md 4.15).
    """

    needs_splats: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        scales = step.output.drawn.gaussians.scales
        smallest = torch.finfo(scales.dtype).tiny  # scales can underflow to 0
        largest, second = scales.topk(2, dim=1).values.clamp(min=smallest).log().unbind(1)
        return (largest - second - math.log(self.settings.max_ratio)).clamp(min=0.0).sum() / max(len(scales), 1)


class SurfaceNormalsSettings(LossSettings):
    """Options of the loss on the normals of Gaussians."""

    every: int = Field(default=1, ge=1)  # steps: the term is 0 at steps that are not a multiple of this


class SurfaceNormalsLoss(Loss[SurfaceNormalsSettings]):
    """Mean 1 - |<n, n_ref>| over all Gaussians: n the shortest axis, n_ref the normal of the nearest initial point.

    The choice of the axis is not differentiated (docs/rivals/gaussian-pancakes.md).
    """

    def check(self, model: TrainedModel) -> None:
        """Refuse fields without reference normals."""
        if model.field.normals_and_references is None:
            raise InputError(
                "loss term 'surface-normals' compares Gaussians with normals of the initial points, and the field has "
                "none",
                "a field of explicit Gaussians with reference normals",
                "Use `field.normal_neighbours=10`, or remove the term",
            )

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (all aligned) to 1."""
        normals = step.model.field.normals_and_references
        if step.step % self.settings.every or normals is None:
            return step.output.alpha.new_zeros(())
        axes, references = normals
        return (1.0 - (axes * references).sum(1).abs()).mean()
