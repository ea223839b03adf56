"""Quantisation of images and depth maps by the authors' 8-bit and 16-bit PNG files (docs/methods.md 5.4)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_LEVELS = 65535


def through_8_bit(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Image written as 8 bit by torchvision's ``save_image`` (times 255, plus 0.5, clamped, truncated) and read back.

    NaN stays NaN, so that the metrics refuse it.

    Args:
        rgb: In [0, 1]; beyond that it is clamped. [H, W, 3]
    """
    return (rgb * 255.0 + 0.5).clamp(0.0, 255.0).floor() / 255.0


def through_16_bit(depth: Float[Tensor, "H W"], full_scale: float) -> Float[Tensor, "H W"]:
    """Depth written as ``(depth / full_scale * 65535).astype(uint16)`` in float32 and read back, mm.

    The cast truncates. It does not clamp: beyond full scale it keeps the lower 16 bits, so 151 mm at a scale of 150 mm
    comes back as 1 mm. That, and 0 for what a 32-bit integer cannot hold (infinity, NaN), is what numpy gives on
    x86-64, where the published values were computed; C leaves both undefined.

    Args:
        depth: mm. [H, W]
        full_scale: Depth of level 65535, mm.
    """
    levels = (depth.float() / full_scale * _LEVELS).trunc()
    fits = levels.abs() < 2.0**31  # False for NaN
    stored = torch.where(fits, levels, 0.0).to(torch.int64) % (_LEVELS + 1)
    return stored.float() / _LEVELS * full_scale
