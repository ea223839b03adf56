"""L1 loss of the rendered depth against a ground-truth depth map."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.masked import masked_mean, zero_outside
from coliags_plugin.core.scenes import Target

#: :data:`coliags_plugin.core.render_output.DEPTH_KINDS` as a literal type; a test compares the two.
DepthKind = Literal["depth_accumulated", "depth_expected", "depth_median", "inverse_depth_accumulated"]


class DepthL1Settings(LossSettings):
    """Options of the depth loss."""

    depth: DepthKind = Field(
        default="depth_accumulated", description="Which rendered depth is compared; the paper's D is depth_accumulated."
    )
    empty_depth: float = Field(
        default=100.0, gt=0.0, description="inverse_depth_accumulated only: depth of a pixel without Gaussians, mm."
    )


class DepthL1Loss(Loss):
    """Mean |D - D_true| in mm over the valid pixels of known true depth (the paper's L_depth; docs/methods.md 4.1).

    The paper writes a sum over pixels and the authors' code takes the mean; this is the mean. The authors' code also
    pulls pixels of unknown depth towards 0; here they are ignored.

    For ``inverse_depth_accumulated`` (E = sum w/z, what the authors' code trains on) D = 1/E where E > 0. Where
    nothing was drawn (E = 0) D is ``empty_depth``, which enters the value but has no gradient.
    """

    Settings: ClassVar[type[LossSettings]] = DepthL1Settings
    needs: ClassVar[frozenset[str]] = frozenset({"depth"})

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, mm; 0 where no valid pixel has a true depth.

        Raises:
            InputError: The target has no depth at all.
        """
        depth, known = known_depth(step.target, "depth-l1")
        rendered = step.output[self.settings.depth]
        if self.settings.depth == "inverse_depth_accumulated":
            rendered = _reciprocal(rendered, self.settings.empty_depth)
        truth = depth.to(rendered.dtype)
        difference = zero_outside(rendered, known) - zero_outside(truth, known)
        return masked_mean(difference.abs(), known)


def known_depth(target: Target, loss: str) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """The true z-depth and where it is known and valid.

    Args:
        target: What is compared with.
        loss: Name of the asking loss.

    Raises:
        InputError: The target has no depth at all.
    """
    if target.depth is None:
        raise InputError(
            f"frame '{target.name}' has no depth",
            f"ground-truth depth for every training frame, since the losses include {loss}",
            "Remove the term with --set losses.depth=null",
        )
    return target.depth, torch.isfinite(target.depth) & target.valid


def _reciprocal(inverse_depth: Float[Tensor, "H W"], empty_depth: float) -> Float[Tensor, "H W"]:
    """1/E where E > 0, else ``empty_depth``; both operands are masked so that no gradient becomes NaN. [H, W]"""
    drawn = inverse_depth > 0
    return torch.where(drawn, 1.0 / torch.where(drawn, inverse_depth, 1.0), empty_depth)
