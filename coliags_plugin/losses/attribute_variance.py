"""Loss on the variance of an attribute over the Gaussians drawn."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.losses.channels import drawn_channel, refuse_without_channel


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
