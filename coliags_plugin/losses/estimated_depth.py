"""Robust loss of the rendered depth against estimated depth, relative to it."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.masked import masked_mean, zero_outside
from coliags_plugin.losses.depth import DepthKind, known_depth, smooth_l1, where_drawn


class EstimatedDepthSettings(LossSettings):
    """Options of the loss against estimated depth."""

    depth: DepthKind = Field(
        default="depth_accumulated", description="Which rendered depth is compared; depth_median has no gradient."
    )
    floor: float = Field(
        default=0.1, ge=0.0, le=1.0, description="Weight of a pixel whose confidence is lower than this."
    )
    delta: float = Field(
        default=0.05,
        gt=0.0,
        description="Huber threshold of the relative difference: smaller ones are squared and divided by twice this.",
    )


class EstimatedDepthLoss(Loss[EstimatedDepthSettings]):
    """Mean of max(c, floor) h(|D - z| / z) over the valid pixels of known depth z of confidence c.

    h is Huber's function with slope 1 beyond ``delta`` (docs/methods.md 4.6). Relative to z, it needs no unit of
    length. Divided by the number of pixels, not by the sum of weights, so that a frame of nothing but prior depth
    guides weakly, too. Depth without confidence counts as certain.
    """

    Settings: ClassVar[type[LossSettings]] = EstimatedDepthSettings
    needs: ClassVar[frozenset[str]] = frozenset({"depth"})

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where no valid pixel has a depth.

        Raises:
            InputError: The target has no depth at all.
        """
        depth, known = known_depth(step.target)
        known = known & (depth > 0)
        rendered, options = step.output[self.settings.depth], self.settings
        estimate = torch.where(known, depth, 1.0).to(rendered.dtype)
        rendered, known = where_drawn(rendered, known, options.depth)
        difference = (zero_outside(rendered - estimate, known) / estimate).abs()
        penalty = smooth_l1(difference, options.delta)
        if step.target.depth_confidence is not None:
            penalty = penalty * step.target.depth_confidence.to(penalty.dtype).clamp_min(options.floor)
        return masked_mean(penalty, known)
