"""Detection of depth discontinuities in the ground truth: silhouettes of folds against the lumen behind them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def depth_steps(depth: Float[Tensor, "H W"], known: Bool[Tensor, "H W"], relative_step: float) -> Bool[Tensor, "H W"]:
    """Mask of pixels whose 3x3 window holds a depth step: (max - min) / min of its known depths above a threshold.

    Unknown pixels make no step themselves; two known surfaces on either side of one do. [H, W]

    Args:
        depth: z-depth, mm. [H, W]
        known: True where the depth is known. [H, W]
        relative_step: Threshold, for instance 0.12.
    """
    farthest = _window_max(torch.where(known, depth, -torch.inf), 1)
    nearest = -_window_max(torch.where(known, -depth, -torch.inf), 1)
    return farthest - nearest > relative_step * nearest


def dilated(marked: Bool[Tensor, "H W"], reach: int) -> Bool[Tensor, "H W"]:
    """The mask dilated by ``reach`` rows and columns. [H, W]"""
    return _window_max(marked.to(torch.float32), reach) > 0


def _window_max(values: Float[Tensor, "H W"], reach: int) -> Float[Tensor, "H W"]:
    """Maximum over the square window around every pixel; pixels outside the image do not count. [H, W]"""
    from kornia.morphology import dilation

    square = torch.ones(2 * reach + 1, 2 * reach + 1, dtype=values.dtype, device=values.device)
    largest: Tensor = dilation(values[None, None], square, max_val=torch.finfo(values.dtype).max)
    return largest[0, 0]
