"""Loss that keeps the factors of a network on the diffuse reflection near 1."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.losses.channels import drawn_channel, refuse_without_channel


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
