"""Loss on the orientation of Gaussians against normals of the initial points."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainedModel, TrainingStep
from coliags_plugin.core.errors import InputError


class SurfaceNormalsSettings(LossSettings):
    """Options of the loss on the normals of Gaussians."""

    every: int = Field(default=1, ge=1)  # steps: the term is 0 at steps that are not a multiple of this


class SurfaceNormalsLoss(Loss[SurfaceNormalsSettings]):
    """Mean 1 - |<n, n_ref>| over all Gaussians: n the shortest axis, n_ref the normal of the nearest initial point.

    The choice of the axis is not differentiated (docs/rivals/gaussian-pancakes.md).
    """

    Settings: ClassVar[type[LossSettings]] = SurfaceNormalsSettings

    def check(self, model: TrainedModel) -> None:
        """Refuse fields without reference normals.

        Raises:
            InputError: See above.
        """
        if model.field.normals_and_references is None:
            raise InputError(
                "loss term 'surface-normals' compares Gaussians with normals of the initial points, and the field has "
                "none",
                "a field of explicit Gaussians with reference normals",
                "Set --set field.normal_neighbours=10, or remove the term",
            )

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, from 0 (all aligned) to 1."""
        normals = step.model.field.normals_and_references
        if step.step % self.settings.every or normals is None:
            return step.output.alpha.new_zeros(())
        own, references = normals
        return (1.0 - (own * references).sum(1).abs()).mean()
