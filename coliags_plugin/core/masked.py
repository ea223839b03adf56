"""Masking of values, and plain and weighted means, with exactly zero gradients at ignored pixels."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def zero_outside(values: Float[Tensor, "H W *C"], mask: Bool[Tensor, "H W"] | None) -> Float[Tensor, "H W *C"]:
    """The values where the mask is True, or everywhere without one; 0 elsewhere.

    Selected with ``torch.where``, not multiplied: NaN or infinity outside still yields 0 and a gradient of exactly 0.
    """
    if mask is None:
        return values
    inside = mask if values.dim() == mask.dim() else mask[..., None]
    return torch.where(inside, values, torch.zeros((), dtype=values.dtype, device=values.device))


def masked_mean(values: Float[Tensor, "H W *C"], mask: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Mean over the pixels (and channels) where the mask is True; 0, still part of the graph, where there are none.

    A full mask, or none, gives the unmasked mean to the bit.
    """
    # Sums run in memory order, and ``torch.where`` may lay its result out differently from its input.
    values = values.contiguous()
    if mask is None:
        return values.sum() / max(values.numel(), 1)
    per_pixel = values.shape[2] if values.dim() > mask.dim() else 1
    return zero_outside(values, mask).sum() / (mask.sum() * per_pixel).clamp_min(1)


def weighted_mean(
    values: Float[Tensor, "H W"], mask: Bool[Tensor, "H W"], weights: Float[Tensor, "H W"] | None
) -> Float[Tensor, ""]:
    """Weighted mean over the pixels where the mask is True: sum w v / sum w; 0, still part of the graph, if sum w = 0.

    Weights are not negative; without them it is :func:`masked_mean` to the bit.
    """
    if weights is None:
        return masked_mean(values, mask)
    inside = zero_outside(weights.to(values.dtype), mask)
    total = inside.sum()
    return (zero_outside(values, mask) * inside).sum() / torch.where(total > 0, total, torch.ones_like(total))
