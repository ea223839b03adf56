"""Regularization loss on the volume of the Gaussians."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep


class ScaleVolumeLoss(Loss):
    """Mean product of the scales of the Gaussians drawn (the paper's L_scale; docs/methods.md 4.1).

    In scene units cubed (mm^3; squared for surfels), so its weight depends on the unit of length (docs/methods.md 4.4).
    """

    Settings: ClassVar[type[LossSettings]] = LossSettings
    needs_splats: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the camera sees no Gaussians."""
        scales = step.output.drawn.gaussians.scales
        return scales.prod(dim=-1).sum() / max(len(scales), 1)
