"""Bilinear sampling of images, and of maps with unknown pixels."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.transfers import constant


def bilinear(image: Float[Tensor, "H W C"], pixels: Float[Tensor, "A B 2"]) -> Float[Tensor, "A B C"]:
    """Sample an image bilinearly at columns and rows, clamped at its edges; pixel centres are at integers + 0.5."""
    size = constant((image.shape[1], image.shape[0]), pixels)
    grid = (2.0 * pixels / size - 1.0).to(image)[None]
    planes = image.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)
    return sampled[0].permute(1, 2, 0)


def interpolated(
    values: Float[Tensor, "H W"], usable: Bool[Tensor, "H W"], pixels: Float[Tensor, "K 2"]
) -> tuple[Float[Tensor, "K"], Bool[Tensor, "K"]]:
    """Bilinear samples of a map at points, and whether all interpolated pixels are usable.

    Points are columns and rows, pixel centres at integers + 0.5; those outside the map are not usable. Unusable
    pixels may be NaN, and affect no value and no gradient; samples of unusable points mean nothing.
    """
    height, width = values.shape
    size = constant((width, height), pixels)
    inside = ((pixels >= 0) & (pixels <= size)).all(dim=1)
    # Pixel centres at integers from here on; the border is replicated.
    place = torch.minimum((torch.where(inside[:, None], pixels, 0.5) - 0.5).clamp_min(0.0), size - 1)
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
