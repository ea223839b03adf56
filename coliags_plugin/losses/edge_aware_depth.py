"""L1 loss of the rendered depth that trusts pixels beside steps of the true depth less."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import LossSettings, TrainingStep
from coliags_plugin.losses.depth import DepthL1Loss, DepthL1Settings, known_depth


class EdgeAwareDepthL1Settings(DepthL1Settings):
    """Options of the edge-aware depth loss."""

    step: float = Field(
        default=0.1, gt=0.0, description="Depths in a window of 3x3 pixels that differ by more, relatively, are a step."
    )
    weight_at_steps: float = Field(default=0.1, ge=0.0, le=1.0, description="Weight of pixels at steps.")


class EdgeAwareDepthL1Loss(DepthL1Loss):
    """``depth-l1`` with a lower weight where the true depth steps within 3x3 pixels (docs/methods.md 4.9).

    A pixel across a step sees two surfaces, and no single depth of Gaussians that are true elsewhere renders it.
    """

    Settings: ClassVar[type[LossSettings]] = EdgeAwareDepthL1Settings
    whole_image: ClassVar[bool] = True

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; see :class:`DepthLoss`."""
        depth, known = known_depth(step.target)
        at_step = steps(torch.where(known, depth, torch.nan), self.settings.step)
        weights = torch.where(at_step, self.settings.weight_at_steps, 1.0).to(depth.dtype)
        if step.target.depth_confidence is not None:
            weights = weights * step.target.depth_confidence.to(weights.dtype)
        return super().__call__(replace(step, target=replace(step.target, depth_confidence=weights)))


def steps(depth: Float[Tensor, "H W"], relative: float) -> Tensor:
    """Where the largest known depth in a window of 3x3 pixels exceeds the smallest by more than a share of it. [H, W]

    Args:
        depth: z-depth; NaN where unknown. [H, W]
        relative: That share.
    """

    def largest(values: Tensor) -> Tensor:
        return torch.nn.functional.max_pool2d(values[None, None], 3, stride=1, padding=1)[0, 0]

    known = torch.isfinite(depth)
    high, low = largest(torch.where(known, depth, -torch.inf)), -largest(torch.where(known, -depth, -torch.inf))
    return known & (high > (1.0 + relative) * low)
