"""Loss on transparent pixels."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.masked import masked_mean


class OpacityLoss(Loss):
    """Mean of 1 - alpha over the valid pixels: a colon is closed, so that every ray ends on tissue.

    Without it, a dark lumen is matched as well by nothing in front of the black background (docs/methods.md 4.6).
    """

    Settings: ClassVar[type[LossSettings]] = LossSettings

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (opaque) to 1; 0 where no pixel is valid."""
        return masked_mean(1.0 - step.output.alpha, step.target.mask)
