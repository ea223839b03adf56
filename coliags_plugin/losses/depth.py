"""Losses of the rendered depth against a ground-truth depth map: L1 and Huber."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from typing_extensions import TypeVar

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.masked import weighted_mean, zero_outside
from coliags_plugin.core.scenes import Target

#: :data:`coliags_plugin.core.render_output.DEPTH_KINDS` as a literal type; a test compares the two.
DepthKind = Literal["depth_accumulated", "depth_expected", "depth_median", "inverse_depth_accumulated"]


class DepthL1Settings(LossSettings):
    """Options of the L1 depth loss."""

    depth: DepthKind = Field(
        default="depth_accumulated", description="Which rendered depth is compared; the paper's D is depth_accumulated."
    )
    empty_depth: float = Field(
        default=100.0, gt=0.0, description="inverse_depth_accumulated only: depth of a pixel without Gaussians, mm."
    )


class DepthHuberSettings(DepthL1Settings):
    """Options of the Huber depth loss."""

    delta: float = Field(default=0.2, gt=0.0, description="Difference at which the loss becomes linear, scene units.")


#: Settings of a depth loss.
DepthLossT = TypeVar("DepthLossT", bound=DepthL1Settings, default=DepthL1Settings)


class DepthLoss(Loss[DepthLossT]):
    """Mean penalty of D - D_true over the valid pixels of known depth, weighted by its confidence if it is estimated.

    For ``inverse_depth_accumulated`` (E = sum w/z, what the authors' code of the paper trains on) D = 1/E where E > 0.
    Where nothing was drawn (E = 0) D is ``empty_depth``, which enters the value but has no gradient.
    """

    Settings: ClassVar[type[LossSettings]] = DepthL1Settings
    needs: ClassVar[frozenset[str]] = frozenset({"depth"})
    trusts_depth: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    @abstractmethod
    def penalty(self, differences: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Penalty of each difference in depth. [H, W]"""

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term; 0 where no valid pixel has a depth that is trusted at all.

        Raises:
            InputError: The target has no depth at all.
        """
        depth, known = known_depth(step.target)
        rendered = step.output[self.settings.depth]
        if self.settings.depth == "inverse_depth_accumulated":
            rendered = _reciprocal(rendered, self.settings.empty_depth)
        truth = depth.to(rendered.dtype)
        penalties = self.penalty(zero_outside(rendered, known) - zero_outside(truth, known))
        return weighted_mean(penalties, known, step.target.depth_confidence)


class DepthL1Loss(DepthLoss):
    """Mean |D - D_true| in mm over the valid pixels of known true depth (the paper's L_depth; docs/methods.md 4.1).

    The paper writes a sum over pixels and the authors' code takes the mean; this is the mean. The authors' code also
    pulls pixels of unknown depth towards 0; here they are ignored.
    """

    def penalty(self, differences: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Their absolute values, mm. [H, W]"""
        return differences.abs()


class DepthHuberLoss(DepthLoss[DepthHuberSettings]):
    """Mean Huber loss of the depth: x^2 / 2 for |x| up to ``delta``, beyond it delta (|x| - delta / 2).

    Used by Gaussian Pancakes and PR-Endo (docs/rivals/gaussian-pancakes.md).
    """

    Settings: ClassVar[type[LossSettings]] = DepthHuberSettings

    def penalty(self, differences: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
        """Huber's function of them, mm squared. [H, W]"""
        return torch.nn.functional.huber_loss(
            differences, torch.zeros_like(differences), reduction="none", delta=self.settings.delta
        )


def known_depth(target: Target) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """The z-depth to compare with, and where it is known and valid.

    Args:
        target: What is compared with.

    Raises:
        InputError: The target has no depth at all.
    """
    if target.depth is None:
        raise InputError(
            f"frame '{target.name}' has no depth",
            "depth for every training frame, since the losses include one of depth",
            "Remove that term, for instance with --set losses.depth=null",
        )
    return target.depth, torch.isfinite(target.depth) & target.valid


def where_drawn(
    rendered: Float[Tensor, "H W"], usable: Bool[Tensor, "H W"], kind: str
) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Rendered depth, of inverse depth the reciprocal, and the usable pixels that have one.

    Args:
        rendered: An output of one of the kinds of depth. [H, W]
        usable: Pixels that are compared where something was drawn. [H, W]
        kind: Name of the output.
    """
    if kind != "inverse_depth_accumulated":
        return rendered, usable
    usable = usable & (rendered > 0)
    return 1.0 / torch.where(usable, rendered, 1.0), usable


def smooth_l1(differences: Float[Tensor, "*N"], beta: float) -> Float[Tensor, "*N"]:
    """Huber's function of slope 1: x^2 / (2 beta) for |x| up to ``beta``, beyond it |x| - beta / 2. [*N]"""
    zero = torch.zeros_like(differences)
    return torch.nn.functional.smooth_l1_loss(differences, zero, reduction="none", beta=beta)


def _reciprocal(inverse_depth: Float[Tensor, "H W"], empty_depth: float) -> Float[Tensor, "H W"]:
    """1/E where E > 0, else ``empty_depth``; both operands are masked so that no gradient becomes NaN. [H, W]"""
    drawn = inverse_depth > 0
    return torch.where(drawn, 1.0 / torch.where(drawn, inverse_depth, 1.0), empty_depth)
