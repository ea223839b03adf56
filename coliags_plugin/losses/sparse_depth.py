"""L1 loss of the rendered depth against sparse depth, such as that of structure-from-motion points."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.interpolation import interpolated
from coliags_plugin.losses.depth import DepthKind, smooth_l1, where_drawn


class SparseDepthSettings(LossSettings):
    """Options of the sparse depth loss."""

    depth: DepthKind = Field(
        default="depth_expected", description="Which rendered depth is compared; depth_median has no gradient."
    )
    huber: float | None = Field(
        default=None,
        gt=0.0,
        description="Huber threshold, of the differences' unit: smaller ones are squared and divided by twice this; "
        "null: absolute differences.",
    )
    relative: bool = Field(
        default=False,
        description="Whether differences are divided by the known depth, so that the weight needs no unit of length.",
    )


class SparseDepthLoss(Loss[SparseDepthSettings]):
    """Mean |D(p) - z|, or |D(p) - z| / z, over the points p of a frame whose z-depth is known (docs/methods.md 4.5).

    After DS-NeRF (Deng et al., "Depth-supervised NeRF: Fewer Views and Faster Training for Free", CVPR 2022). D is
    interpolated bilinearly at a point, with border pixels replicated. A point is used if all interpolated pixels are
    valid and have alpha > 0.
    """

    Settings: ClassVar[type[LossSettings]] = SparseDepthSettings
    needs: ClassVar[frozenset[str]] = frozenset({"sparse_depth"})
    whole_image: ClassVar[bool] = True

    @property
    def wants(self) -> frozenset[str]:
        """The rendered depth that is compared."""
        return frozenset({self.settings.depth})

    def __call__(self, step: TrainingStep) -> Float[Tensor, ""]:
        """The unweighted term, scene units unless ``relative``; 0, still part of the graph, if no point is used."""
        rendered, points = step.output[self.settings.depth], step.target.sparse_depth
        if points is None or not len(points.depth):
            return rendered.reshape(-1)[:0].sum()
        drawn = (step.output.alpha > 0) & step.target.valid & torch.isfinite(rendered)
        rendered, drawn = where_drawn(rendered, drawn, self.settings.depth)
        sampled, counts = interpolated(rendered, drawn, points.pixels)
        truth = points.depth.to(rendered.dtype)
        if self.settings.relative:
            counts = counts & (truth > 0)
        difference = torch.where(counts, sampled - truth, 0.0).abs()
        if self.settings.relative:
            difference = difference / torch.where(counts, truth, 1.0)
        if (near := self.settings.huber) is not None:
            difference = smooth_l1(difference, near)
        return difference.sum() / counts.sum().clamp_min(1)
