"""Bilinear sampling of images."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.transfers import constant


def bilinear(image: Float[Tensor, "H W C"], pixels: Float[Tensor, "A B 2"]) -> Float[Tensor, "A B C"]:
    """Sample an image bilinearly at columns and rows, clamped at its edges; pixel centres are at integers + 0.5."""
    size = constant((image.shape[1], image.shape[0]), pixels)
    grid = (2.0 * pixels / size - 1.0).to(image)[None]
    planes = image.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)
    return sampled[0].permute(1, 2, 0)
