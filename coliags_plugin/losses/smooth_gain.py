"""Loss on changes of the gain that are not steady in time."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import GainModule, Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.core.errors import InputError, did_you_mean


class SmoothGainSettings(LossSettings):
    """Options of the loss on gains."""

    module: str = Field(default="exposure", description="Name of the view module 'gain' in the method config.")


class SmoothGainLoss(Loss[SmoothGainSettings]):
    """Mean squared change of slope of the log gain over time, per frame of the video (docs/methods.md 4.7).

    Slopes are those between training frames that follow each other; 0 with fewer than three.
    """

    Settings: ClassVar[type[LossSettings]] = SmoothGainSettings

    def check(self, model: TrainedModel) -> None:
        """Refuse methods without that module.

        Raises:
            InputError: See above.
        """
        self._gains(model)

    def _gains(self, model: TrainedModel) -> GainModule:
        module = model.view_modules.get(self.settings.module)
        if not isinstance(module, GainModule):
            known = [name for name, part in model.view_modules.items() if isinstance(part, GainModule)]
            raise InputError(
                f"loss 'smooth-gain' reads the gains of module '{self.settings.module}'",
                f"the name of a module 'gain', one of {', '.join(known)}" if known else "a module 'gain'",
                did_you_mean(self.settings.module, known),
            )
        return module

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term."""
        module = self._gains(step.model)
        log_gains = module.log_gains()
        if len(log_gains) < 3:
            return log_gains.sum() * 0.0
        gaps = log_gains.new_tensor(module.times).diff().clamp_min(1.0)[:, None]
        slopes = log_gains.diff(dim=0) / gaps
        return slopes.diff(dim=0).square().mean()
