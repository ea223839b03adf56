"""Front-to-back alpha compositing of 2D Gaussians, tile by tile.

The recursion and its derivative are written out in ``docs/rendering.md``, section "Compositing". Two properties make
plain tensor operations fast. Within a tile the logarithm of alpha is a quadratic polynomial of the pixel position, so
all pixels of all pairs come from one matrix product with six monomials, and the gradients of the six coefficients from
its transpose. And the backward pass sweeps front to back once more instead of storing anything per pixel and pair.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.renderers.splatting import CutSettings
from coliags_plugin.renderers.sweeping import Chunk, crossing_of_half, padded_rows, sweep
from coliags_plugin.renderers.tiles import TileGrid, TilePairs


def log_alpha_polynomials(
    log_opacities: Float[Tensor, "M"], whitenings: Float[Tensor, "M 3"], offsets: Float[Tensor, "M 2"]
) -> Float[Tensor, "M 6"]:
    """Coefficients of log(opacity) - |U (offset + p)|^2 / 2 in the monomials of p that :func:`monomials` gives.

    ``whitenings`` are u_xx, u_yx, u_yy of the lower triangular U, 1 / pixels; ``offsets`` lead from the Gaussian's
    centre to the origin of p, pixels.
    """
    u_xx, u_yx, u_yy = whitenings.unbind(-1)
    x, y = offsets.unbind(-1)
    # Whitening the offset before squaring keeps needles accurate: nothing larger than the result is ever cancelled.
    e, f = u_xx * x, u_yx * x + u_yy * y
    return torch.stack(
        [
            log_opacities - 0.5 * (e * e + f * f),
            -(e * u_xx + f * u_yx),
            -f * u_yy,
            -0.5 * (u_xx * u_xx + u_yx * u_yx),
            -u_yx * u_yy,
            -0.5 * u_yy * u_yy,
        ],
        dim=-1,
    )


def monomials(points: Float[Tensor, "P 2"]) -> Float[Tensor, "6 P"]:
    """1, x, y, x^2, x y, y^2 of points. [6, P]"""
    x, y = points.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def composite_gaussians(
    table: Float[Tensor, "N 6+F"],
    depths: Float[Tensor, "N"] | None,
    pairs: TilePairs,
    grid: TileGrid,
    cuts: CutSettings,
) -> tuple[Float[Tensor, "H W F"], Float[Tensor, "H W"] | None]:
    """Composite the pairs of each tile: :class:`~coliags_plugin.renderers.stages.Stages`."""
    # One lookup: its gradient is the most expensive step outside compositing.
    of_pairs = table.index_select(0, pairs.gaussian)
    offsets = grid.centers(pairs.tile, table.dtype) - of_pairs[:, :2]
    polynomials = log_alpha_polynomials(of_pairs[:, 5], of_pairs[:, 2:5], offsets)
    pixels = monomials(grid.offsets(table))
    sums = grid.to_image(composite(polynomials, of_pairs[:, 6:], pairs.starts, pixels, cuts))
    if depths is None:
        return sums, None
    medians = median_depths(polynomials, depths[pairs.gaussian], pairs.starts, pixels, cuts)
    return sums, grid.to_image(medians[:, None])[..., 0]


def composite(
    polynomials: Float[Tensor, "M 6"],
    features: Float[Tensor, "M F"],
    starts: Int[Tensor, "tiles+1"],
    pixels: Float[Tensor, "6 P"],
    cuts: CutSettings,
) -> Float[Tensor, "tiles F P"]:
    """Sum of weight times feature over the pairs of each tile, at each of its pixels.

    Differentiable (once) in ``polynomials``, of :func:`log_alpha_polynomials` by tile and front to back, and in
    ``features``. ``starts`` is the first pair of each tile, and M; ``pixels`` are the :func:`monomials` of a tile's
    pixel centres.
    """
    composited: Tensor = _Composite.apply(polynomials, features, starts, pixels, cuts)  # type: ignore[no-untyped-call]
    return composited


@torch.no_grad()
def median_depths(
    polynomials: Float[Tensor, "M 6"],
    depths: Float[Tensor, "M"],
    starts: Int[Tensor, "tiles+1"],
    pixels: Float[Tensor, "6 P"],
    cuts: CutSettings,
) -> Float[Tensor, "tiles P"]:
    """Depth of the pair that brings the transmittance to one half or less; 0 where none does. [tiles, P]"""
    medians = depths.new_zeros(len(starts) - 1, pixels.shape[1])
    for chunk in _sweep(padded_rows(polynomials, 0), starts, pixels, cuts):
        crossing, crosses = crossing_of_half(chunk)
        rows = chunk.rows.view(chunk.weights.shape[:2]).gather(1, crossing).clamp_max(len(depths) - 1)
        medians[chunk.tiles] += torch.where(crosses, depths[rows], 0.0)
    return medians


def _sweep(padded: Tensor, starts: Tensor, pixels: Tensor, cuts: CutSettings) -> Iterator[Chunk[None]]:
    """Sweep over the pairs of all tiles, the polynomials padded. [M + 1, 6], [tiles + 1], [6, P]"""

    def evaluate(rows: Tensor) -> tuple[Tensor, None]:
        return (padded.index_select(0, rows) @ pixels).exp_(), None

    return sweep(evaluate, starts, padded.new_ones(pixels.shape[1]), cuts)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, polynomials: Tensor, features: Tensor, starts: Tensor, pixels: Tensor, cuts: CutSettings
    ) -> Tensor:
        padded, padded_features = padded_rows(polynomials, 0), torch.nn.functional.pad(features, (0, 0, 0, 1))
        composited = features.new_zeros(len(starts) - 1, features.shape[1], pixels.shape[1])
        for chunk in _sweep(padded, starts, pixels, cuts):
            composited[chunk.tiles] += chunk.rows_of(padded_features).mT @ chunk.weights
        ctx.save_for_backward(padded, padded_features, starts, pixels, composited)
        ctx.cuts = cuts
        return composited

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        padded, padded_features, starts, pixels, composited = ctx.saved_tensors
        of_polynomials, of_features = torch.zeros_like(padded), torch.zeros_like(padded_features)
        gradient = gradient.contiguous()
        # First-order contribution to the loss of the pairs not yet swept.
        behind = (composited * gradient).sum(1)
        for chunk in _sweep(padded, starts, pixels, ctx.cuts):
            tile_gradient = gradient[chunk.tiles]
            of_features[chunk.rows] = (chunk.weights @ tile_gradient.mT).flatten(0, 1)
            gained = (chunk.rows_of(padded_features) @ tile_gradient).mul_(chunk.weights)
            of_polynomials[chunk.rows] = chunk.of_log_alphas(gained, behind, ctx.cuts.alpha_max) @ pixels.T
        return of_polynomials[:-1], of_features[:-1], None, None, None
