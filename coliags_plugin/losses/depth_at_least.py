"""One-sided loss of the rendered depth where the depth sensor clipped."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.masked import masked_mean, zero_outside
from coliags_plugin.losses.depth import DepthKind, where_drawn


class DepthAtLeastSettings(LossSettings):
    """Options of the one-sided loss."""

    depth: DepthKind = Field(default="depth_accumulated", description="Which rendered depth is compared.")


class DepthAtLeastLoss(Loss):
    """Mean over the valid pixels of max(0, z - D) where the sensor clipped at z, 0 elsewhere (docs/methods.md 4.9).

    Divided by the number of valid pixels, not by that of clipped ones, so that a pixel weighs as much as one of
    ``depth-l1``; 0 in frames where nothing is clipped.
    """

    Settings: ClassVar[type[LossSettings]] = DepthAtLeastSettings

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, scene units."""
        rendered, target = step.output[self.settings.depth], step.target
        if target.depth_at_least is None:
            return zero_outside(rendered, torch.zeros_like(rendered, dtype=torch.bool)).sum()
        clipped = torch.isfinite(target.depth_at_least) & target.valid
        rendered, clipped = where_drawn(rendered, clipped, self.settings.depth)
        bound = zero_outside(target.depth_at_least.to(rendered.dtype), clipped)
        return masked_mean((bound - zero_outside(rendered, clipped)).clamp_min(0.0), target.valid)
