"""Structural similarity as the splatting papers compute it, with a mask that reaches inside the windows.

An 11x11 Gaussian window of sigma 1.5 with zero padding, C1 = 0.01^2, C2 = 0.03^2, data range 1, per channel
(docs/methods.md 2.4). Away from the border this is Wang et al. 2004, and scikit-image's ``structural_similarity`` with
``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.masked import masked_mean, zero_outside

SIGMA = 1.5
#: Half width of the window, pixels.
REACH = 5
C1 = 0.01**2
C2 = 0.03**2

# Rows blurred by one matrix product. The band is REACH wide on either side, so a product over the whole image would
# multiply zeros for the most part, while a much smaller tile would mostly copy.
_TILE = 32


def ssim(
    rendered: Float[Tensor, "H W C"], truth: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Mean of :func:`ssim_map` over the valid pixels and all channels; 0 where no pixel is valid.

    Args:
        rendered: In [0, 1]. [H, W, C]
        truth: In [0, 1]. [H, W, C]
        mask: False where a pixel is to be ignored; None means every pixel counts. [H, W]
    """
    return masked_mean(ssim_map(rendered, truth, mask), mask)


def ssim_map(
    rendered: Float[Tensor, "H W C"], truth: Float[Tensor, "H W C"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W C"]:
    """Structural similarity of the windows around every pixel, differentiable twice.

    With a mask, a window's means, variances and covariance are taken over its valid pixels alone, their weights scaled
    up to the total that the window has without a mask. So an ignored pixel influences neither the value nor the
    gradient of any other; a window without ignored pixels is what it is without a mask, to the bit; and two equal
    images score 1 whatever the mask. (Setting ignored pixels to one common value in both images would do the first,
    but would also put a strong edge that both share into all windows around them and so flatter the score there.)
    The values at the ignored pixels themselves mean nothing: average with :func:`coliags_plugin.masked.masked_mean`.

    Args:
        rendered: In [0, 1]. [H, W, C]
        truth: In [0, 1]. [H, W, C]
        mask: False where a pixel is to be ignored; None means every pixel counts. [H, W]

    Raises:
        ValueError: The images differ in size.
    """
    if rendered.shape != truth.shape or rendered.dim() != 3:
        raise ValueError(f"SSIM of images of shapes {tuple(rendered.shape)} and {tuple(truth.shape)}: both [H, W, C]")
    a = zero_outside(rendered, mask).transpose(1, 2)
    b = zero_outside(truth, mask).transpose(1, 2)
    # Only the sum of the two variances is ever used, so one blur serves both. The truth is blurred apart, which spares
    # the backward pass a blur of a gradient that nobody asked for.
    mean_a, squares, products = _blur(torch.cat([a, a * a + b * b, a * b], dim=1)).chunk(3, dim=1)
    mean_b = _blur(b)
    if mask is not None:
        gain = _coverage_gain(mask, a.dtype)
        mean_a, mean_b, squares, products = mean_a * gain, mean_b * gain, squares * gain, products * gain
    product_of_means = mean_a * mean_b
    squared_means = mean_a * mean_a + mean_b * mean_b
    likeness = (2.0 * product_of_means + C1) * (2.0 * (products - product_of_means) + C2)
    energy = (squared_means + C1) * (squares - squared_means + C2)
    return (likeness / energy).permute(2, 0, 1)


def _coverage_gain(mask: Bool[Tensor, "H W"], dtype: torch.dtype) -> Float[Tensor, "W 1 H"]:
    """By how much each window's weights grow to make up for its ignored pixels; 0 around an ignored pixel."""
    covered = _blur(mask.to(dtype)[:, None])
    whole = _blur(torch.ones_like(mask, dtype=dtype)[:, None])
    inside = mask.T[:, None]
    return torch.where(inside, whole, 0.0) / torch.where(inside, covered, 1.0)


def _blur(images: Float[Tensor, "H C W"]) -> Float[Tensor, "W C H"]:
    """Both passes of the Gaussian window with zero padding; rows and columns come out exchanged."""
    blurred: Tensor = _Blur.apply(images)  # type: ignore[no-untyped-call]
    return blurred


class _Blur(torch.autograd.Function):
    """The window is symmetric and the padding zero, so the blur is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, images: Tensor) -> Tensor:
        return _blur_rows(_blur_rows(images).transpose(0, 2))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return _blur(gradient)


def _blur_rows(images: Float[Tensor, "H C W"]) -> Float[Tensor, "H C W"]:
    """Along the first dimension, as a product with a banded matrix, tile of rows by tile of rows.

    Products cost much the same on every thread count and dtype: 12 ms for one SSIM of 338x270 with its gradient. A
    depth-wise ``conv2d`` took from 16 ms to over a second on the same machine, depending on both.
    """
    height, channels, width = images.shape
    tiles = -(-height // _TILE)
    padded = images.new_zeros(tiles * _TILE + 2 * REACH, channels * width)
    padded[REACH : REACH + height] = images.reshape(height, -1)
    overlapping = padded.unfold(0, _TILE + 2 * REACH, _TILE).transpose(1, 2)
    band = _band(images.dtype, images.device).expand(tiles, -1, -1)
    return torch.bmm(band, overlapping).view(-1, channels, width)[:height]


@lru_cache(maxsize=16)
def _band(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "T S"]:
    """The window's weights, shifted by one from row to row. [_TILE, _TILE + 2 * REACH]"""
    # Kept between calls, so it must not be an inference tensor: those cannot take part in a later backward pass.
    with torch.inference_mode(False):
        offsets = torch.arange(2 * REACH + 1, dtype=torch.float64) - REACH
        weights = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
        weights = weights / weights.sum()
        band = torch.zeros(_TILE, _TILE + 2 * REACH, dtype=torch.float64)
        for row in range(_TILE):
            band[row, row : row + len(weights)] = weights
        return band.to(dtype=dtype, device=device)
