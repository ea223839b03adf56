"""L1 loss of the rendered depth against sparse depth, such as that of structure-from-motion points."""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Loss, LossSettings, TrainingStep
from coliags_plugin.core.scenes import SparseDepth
from coliags_plugin.losses.depth import DepthKind


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


class SparseDepthLoss(Loss):
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
        if self.settings.depth == "inverse_depth_accumulated":
            drawn = drawn & (rendered > 0)
            rendered = 1.0 / torch.where(drawn, rendered, 1.0)
        sampled, counts = _interpolated(rendered, drawn, points)
        truth = points.depth.to(rendered.dtype)
        if self.settings.relative:
            counts = counts & (truth > 0)
        difference = torch.where(counts, sampled - truth, 0.0).abs()
        if self.settings.relative:
            difference = difference / torch.where(counts, truth, 1.0)
        if (near := self.settings.huber) is not None:
            difference = torch.where(difference < near, difference.square() / (2.0 * near), difference - 0.5 * near)
        return difference.sum() / counts.sum().clamp_min(1)


def _interpolated(
    values: Float[Tensor, "H W"], usable: Bool[Tensor, "H W"], points: SparseDepth
) -> tuple[Float[Tensor, "K"], Bool[Tensor, "K"]]:
    """Bilinear samples of a map at points, and whether all interpolated pixels are usable.

    Unusable pixels may be NaN; they affect no value and no gradient. Points outside the map are not usable.
    """
    height, width = values.shape
    size = points.pixels.new_tensor([width, height])
    inside = ((points.pixels >= 0) & (points.pixels <= size)).all(dim=1)
    # Pixel centres at integers from here on; the border is replicated.
    place = torch.minimum((torch.where(inside[:, None], points.pixels, 0.5) - 0.5).clamp_min(0.0), size - 1)
    corner = torch.minimum(place.floor(), (size - 2).clamp_min(0))
    share = (place - corner).to(values.dtype)
    column, row = corner.long().unbind(1)
    total, counts = values.new_zeros(len(place)), inside
    for down in (0, 1):
        for across in (0, 1):
            weight = (share[:, 0] if across else 1 - share[:, 0]) * (share[:, 1] if down else 1 - share[:, 1])
            index = ((row + down).clamp_max(height - 1), (column + across).clamp_max(width - 1))
            fine = usable[index]
            total = total + weight * torch.where(fine, values[index], 0.0)
            counts = counts & (fine | (weight == 0))
    return total, counts
