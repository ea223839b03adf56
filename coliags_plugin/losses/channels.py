"""Losses of feature channels of the Gaussians drawn."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.core.errors import InputError, did_you_mean


def drawn_channel(step: TrainingStep, channel: str) -> Float[Tensor, "N C"]:
    """A feature channel of the Gaussians that were drawn. [N, C]"""
    return step.output.drawn.gaussians.features[channel]


def refuse_without_channel(model: TrainedModel, channel: str, loss: str) -> None:
    """Refuse a field that lacks a feature channel.

    Args:
        model: The model.
        channel: Name of the channel.
        loss: Name of the loss that reads it.

    Raises:
        InputError: See above.
    """
    known = sorted(model.field.feature_channels)
    if channel not in known:
        raise InputError(
            f"loss '{loss}' reads channel '{channel}' of the Gaussians, and the field has {', '.join(known) or 'none'}",
            "a channel of the field",
            did_you_mean(channel, known) or "Remove the term, or choose another field, such as lit-gaussians",
        )


class AttributeVarianceSettings(LossSettings):
    """Options of the loss on variances."""

    attribute: str  # feature channel of the field, for instance albedo


class AttributeVarianceLoss(Loss[AttributeVarianceSettings]):
    """Variance of a feature channel over the Gaussians drawn, averaged over its components (docs/rivals/pr-endo.md)."""

    Settings: ClassVar[type[LossSettings]] = AttributeVarianceSettings
    needs_splats: ClassVar[bool] = True

    def check(self, model: TrainedModel) -> None:
        """Refuse fields without this channel.

        Raises:
            InputError: See above.
        """
        refuse_without_channel(model, self.settings.attribute, "attribute-variance")

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        values = drawn_channel(step, self.settings.attribute)
        count = max(len(values), 1)
        return (values - values.sum(0) / count).square().mean(1).sum() / count


class DiffuseFactorLoss(Loss):
    """f(t) times the mean (1 - m)^2 over the Gaussians drawn, m the channel ``diffuse_factor``.

    f falls linearly from 1 at ``from_step`` to 0 at ``until_step``, or at the last step where there is none
    (docs/rivals/pr-endo.md).
    """

    Settings: ClassVar[type[LossSettings]] = LossSettings
    needs_splats: ClassVar[bool] = True

    def check(self, model: TrainedModel) -> None:
        """Refuse fields without diffuse factors.

        Raises:
            InputError: See above.
        """
        refuse_without_channel(model, "diffuse_factor", "diffuse-factor")

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        factors = drawn_channel(step, "diffuse_factor")
        return self.share(step) * (1.0 - factors).square().sum() / max(factors.numel(), 1)

    def share(self, step: TrainingStep) -> float:
        """F at this step."""
        schedule, options = step.schedule, self.settings
        start = schedule.at(options.from_step)
        end = schedule.steps if options.until_step is None else schedule.at(options.until_step)
        return min(1.0, max(0.0, (end - step.step) / max(end - start, 1)))
