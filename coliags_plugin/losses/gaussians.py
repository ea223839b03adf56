"""Losses of the Gaussians themselves: their feature channels, volume and orientation."""

from __future__ import annotations

from functools import reduce
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.core.errors import InputError, did_you_mean


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
