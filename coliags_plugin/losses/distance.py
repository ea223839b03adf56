"""L1 loss of the rendered distance along the ray against ground truth, at all or some of the pixels."""

from __future__ import annotations

from typing import ClassVar, Literal

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.masked import weighted_mean, zero_outside
from coliags_plugin.core.pixel_ids import fixed_uniform
from coliags_plugin.losses.depth import known_depth


class DistanceL1Settings(LossSettings):
    """Options of the distance loss."""

    depth: Literal["depth_accumulated", "depth_accumulated_coarse"] = Field(
        default="depth_accumulated", description="Rendered depth whose distance is compared: the final or the coarse."
    )
    unit: Literal["scene", "field"] = Field(
        default="scene", description="Unit of the difference: the scene's, mm in metric data, or the field's own."
    )
    share: float = Field(
        default=1.0, gt=0.0, le=1.0, description="Share of the pixels of each frame that count, drawn once."
    )
    seed: int = Field(default=0, ge=0, description="Seed of that draw.")


class DistanceL1Loss(Loss[DistanceL1Settings]):
    """Mean |t - t_true| over the drawn valid pixels of known depth, t = |r| sum w z = sum w t_i (REIM-NeRF).

    Weighted by the confidence of the depth if it is estimated. |r| is the length of the pixel's ray per z-depth. Which
    pixels are drawn depends on ``seed``, frame and pixel only, so it is the same at every step and in a resumed run.
    """

    Settings: ClassVar[type[LossSettings]] = DistanceL1Settings
    needs: ClassVar[frozenset[str]] = frozenset({"depth"})
    trusts_depth: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth, and the lengths of the rays."""
        return frozenset({self.settings.depth, "ray_lengths"})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term in ``unit``; 0 where no pixel counts.

        Raises:
            InputError: The target has no depth at all.
        """
        depth, known = known_depth(step.target)
        if self.settings.share < 1.0:
            known = known & (fixed_uniform(step.target.ids, self.settings.seed) < self.settings.share)
        rendered = step.output[self.settings.depth]
        difference = zero_outside(rendered, known) - zero_outside(depth.to(rendered.dtype), known)
        error = weighted_mean(difference.abs() * step.output["ray_lengths"], known, step.target.depth_confidence)
        return error / step.model.field.length_unit if self.settings.unit == "field" else error
