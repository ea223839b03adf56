"""A price on large Gaussians."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings
from coliags_plugin.core.gaussians import RenderOutput
from coliags_plugin.core.scenes import Frame


class ScaleVolumeLoss(Loss):
    """Mean product of the scales of the Gaussians drawn (the paper's L_scale; docs/methods.md 4.1).

    In scene units cubed (mm^3; squared for surfels), so its weight depends on the unit of length (docs/methods.md 4.4).
    """

    Settings: ClassVar[type[LossSettings]] = LossSettings

    def __call__(self, output: RenderOutput, frame: Frame) -> Float[Tensor, ""]:
        """The unweighted term; 0 where the view has no Gaussians."""
        scales = output.gaussians.scales
        return scales.prod(dim=-1).sum() / max(len(scales), 1)
