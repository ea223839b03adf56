"""Device functions of both primitives: pixels of a tile, thresholds, blending weights and their gradients."""

from __future__ import annotations

import triton
import triton.language as tl

#: Edge of a tile, pixels. At 16 the blocks of the backward pass do not fit a program's registers.
TILE_SIZE = 8
#: Pairs composited at a time; products of matrices need at least 16.
RANKS = 16
#: Warps of a program.
FORWARD_WARPS, BACKWARD_WARPS = 4, 8


@triton.jit
def tile_pixels(tile, columns, width, height, SIZE: tl.constexpr):
    """Centres of a tile's pixels, their index in the image and whether they are in it. [P] each"""
    place = tl.arange(0, SIZE * SIZE)
    column = (tile % columns) * SIZE + place % SIZE
    row = (tile // columns) * SIZE + place // SIZE
    return column + 0.5, row + 0.5, row * width + column, (column < width) & (row < height)


@triton.jit
def cut(alphas, alpha_min, alpha_max):
    """Alphas clamped above, and 0 below alpha_min."""
    alphas = tl.minimum(alphas, alpha_max)
    return tl.where(alphas >= alpha_min, alphas, 0.0)


@triton.jit
def blend(alphas, before, transmittance_min):
    """Transmittance behind each pair, 0 from the one on that would take it below the bound, and weights. [R, P] each"""
    behind = before[None, :] * tl.cumprod(1.0 - alphas, axis=0)
    behind = tl.where(behind >= transmittance_min, behind, 0.0)
    return behind, alphas / (1.0 - alphas) * behind


@triton.jit
def crosses_half(behind, weights, before, RANKS: tl.constexpr):
    """Mask of the pairs that bring the transmittance to one half or less. [R, P]"""
    open_ranks = tl.sum((behind > 0.5).to(tl.int32), axis=0)
    at = tl.arange(0, RANKS)[:, None] == open_ranks[None, :]
    return at & (before > 0.5)[None, :] & (weights > 0.0)


@triton.jit
def of_log_alphas(gained, hidden, alphas, weights, alpha_max):
    """Gradients of log(alpha), from first-order contributions to the loss: each pair's, and all from here on. [R, P]"""
    behind = hidden[None, :] - tl.cumsum(gained, axis=0)
    derivative = gained - behind * (alphas / (1.0 - alphas))
    return tl.where((weights > 0.0) & (alphas < alpha_max), derivative, 0.0)
