"""Front-to-back alpha compositing of 2D Gaussians, tile by tile.

The recursion and its derivative are written out in ``docs/rendering.md``, section "Compositing". Two properties make
plain tensor operations fast. Within a tile the logarithm of alpha is a quadratic polynomial of the pixel position, so
all pixels of all pairs come from one matrix product with six monomials, and the gradients of the six coefficients from
its transpose. And the backward pass sweeps front to back once more instead of storing anything per pixel and pair.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

#: Elements of the largest temporary tensors, by device type: to fit the L2 caches, or to fill the device.
_CHUNK_ELEMENTS = {"cpu": 2**18, "cuda": 2**24}
#: Fewest and most pairs of one tile composited at a time.
_MIN_RANKS, _MAX_RANKS = 32, 128
#: Finite stand-in for log(0), far below every alpha_min.
_LOG_ZERO = -1e4


@dataclass(frozen=True)
class Cuts:
    """Thresholds of compositing (docs/methods.md 2.2).

    Attributes:
        alpha_max: Upper bound of alpha.
        alpha_min: Contributions of smaller alpha are skipped.
        transmittance_min: Compositing stops before the Gaussian that would bring the transmittance below this.
    """

    alpha_max: float
    alpha_min: float
    transmittance_min: float


def log_alpha_polynomials(
    log_opacities: Float[Tensor, "M"], whitenings: Float[Tensor, "M 3"], offsets: Float[Tensor, "M 2"]
) -> Float[Tensor, "M 6"]:
    """Coefficients of log(opacity) - |U (offset + p)|^2 / 2 in the monomials of p that :func:`monomials` gives.

    Args:
        log_opacities: [M]
        whitenings: u_xx, u_yx, u_yy of the lower triangular U, 1 / pixels. [M, 3]
        offsets: From the Gaussian's centre to the origin of p, pixels. [M, 2]
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


def composite(
    polynomials: Float[Tensor, "M 6"],
    features: Float[Tensor, "M F"],
    starts: Int[Tensor, "tiles+1"],
    pixels: Float[Tensor, "6 P"],
    cuts: Cuts,
) -> Float[Tensor, "tiles F P"]:
    """Sum of weight times feature over the pairs of each tile, at each of its pixels.

    Differentiable (once) in ``polynomials`` and ``features``.

    Args:
        polynomials: Log alpha of each pair, by tile and front to back: :func:`log_alpha_polynomials`. [M, 6]
        features: What to composite. [M, F]
        starts: First pair of each tile, and M. [tiles + 1]
        pixels: :func:`monomials` of the pixel centres of a tile. [6, P]
        cuts: Thresholds.
    """
    composited: Tensor = _Composite.apply(polynomials, features, starts, pixels, cuts)  # type: ignore[no-untyped-call]
    return composited


@torch.no_grad()
def median_depths(
    polynomials: Float[Tensor, "M 6"],
    depths: Float[Tensor, "M"],
    starts: Int[Tensor, "tiles+1"],
    pixels: Float[Tensor, "6 P"],
    cuts: Cuts,
) -> Float[Tensor, "tiles P"]:
    """Depth of the pair that brings the transmittance to one half or less; 0 where none does. [tiles, P]"""
    medians = depths.new_zeros(len(starts) - 1, pixels.shape[1])
    for chunk in _sweep(_padded(polynomials), starts, pixels, cuts):
        tiles, ranks, _ = chunk.weights.shape
        crossing = (chunk.transmittances > 0.5).sum(1).clamp_max(ranks - 1)[:, None]
        crosses = (chunk.before > 0.5) & (chunk.transmittances.gather(1, crossing).squeeze(1) <= 0.5)
        crosses &= chunk.weights.gather(1, crossing).squeeze(1) > 0
        rows = chunk.rows.view(tiles, ranks).gather(1, crossing.squeeze(1)).clamp_max(len(depths) - 1)
        medians[chunk.tiles] += torch.where(crosses, depths[rows], 0.0)
    return medians


class _Chunk(NamedTuple):
    """C consecutive pairs of each of G tiles, at all P pixels.

    Attributes:
        tiles: Which tiles, no two the same. [G]
        rows: Index of each pair in the list of pairs; M, one past its end, where a tile has fewer. [G * C]
        before: Transmittance in front of the chunk; 0 where compositing has stopped. [G, P]
        transmittances: The same behind each pair. [G, C, P]
        alphas: [G, C, P]
        ratios: alpha / (1 - alpha). [G, C, P]
        weights: alpha times the transmittance in front of the pair. [G, C, P]
    """

    tiles: Tensor
    rows: Tensor
    before: Tensor
    transmittances: Tensor
    alphas: Tensor
    ratios: Tensor
    weights: Tensor


def _sweep(padded: Tensor, starts: Tensor, pixels: Tensor, cuts: Cuts) -> Iterator[_Chunk]:
    """Iterate over every tile's pairs front to back until they end or no pixel has transmittance left.

    The arguments are those of :func:`composite`, the polynomials :func:`_padded`. [M + 1, 6], [tiles + 1], [6, P]
    """
    budget = _CHUNK_ELEMENTS.get(padded.device.type, _CHUNK_ELEMENTS["cuda"]) // pixels.shape[1]
    alpha_below = _just_below(cuts.alpha_min, padded)
    transmittance_below = _just_below(cuts.transmittance_min, padded)
    # Tiles with similar numbers of pairs are grouped, so that few rows are padding.
    counts, occupied = starts.diff().sort(descending=True, stable=True)
    occupied = occupied[: int((counts > 0).sum())]
    for group in torch.split(occupied, max(1, budget // _MIN_RANKS)):
        tiles = group
        first, end = starts[tiles], starts[tiles + 1]
        before = padded.new_ones(len(tiles), pixels.shape[1])
        while len(tiles):
            longest = int((end - first).max())
            ranks = min(longest, _MAX_RANKS, max(_MIN_RANKS, budget // len(tiles)))
            rows = first[:, None] + torch.arange(ranks, device=first.device)
            rows = torch.where(rows < end[:, None], rows, len(padded) - 1).flatten()
            alphas = (padded.index_select(0, rows) @ pixels).view(len(tiles), ranks, -1)
            alphas.exp_().clamp_(max=cuts.alpha_max)
            torch.threshold_(alphas, alpha_below, 0.0)
            through = 1 - alphas
            ratios = alphas / through
            through[:, 0] *= before
            transmittances = through.cumprod_(1)
            # Transmittance only falls, so setting it to zero below the bound stops compositing for good.
            torch.threshold_(transmittances, transmittance_below, 0.0)
            # alpha T in front = alpha / (1 - alpha) T behind, which is 0 for the pair that would cross the bound.
            yield _Chunk(tiles, rows, before, transmittances, alphas, ratios, ratios * transmittances)
            before = transmittances[:, -1].clone()
            first = first + ranks
            alive = (first < end) & (before.amax(-1) > 0)
            if not bool(alive.all()):
                tiles, first, end, before = tiles[alive], first[alive], end[alive], before[alive]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, polynomials: Tensor, features: Tensor, starts: Tensor, pixels: Tensor, cuts: Cuts) -> Tensor:
        padded, padded_features = _padded(polynomials), torch.nn.functional.pad(features, (0, 0, 0, 1))
        composited = features.new_zeros(len(starts) - 1, features.shape[1], pixels.shape[1])
        for chunk in _sweep(padded, starts, pixels, cuts):
            chunk_features = padded_features.index_select(0, chunk.rows).view(*chunk.weights.shape[:2], -1)
            composited[chunk.tiles] += chunk_features.mT @ chunk.weights
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
            chunk_features = padded_features.index_select(0, chunk.rows).view(*chunk.weights.shape[:2], -1)
            of_features[chunk.rows] = (chunk.weights @ tile_gradient.mT).flatten(0, 1)

            gained = (chunk_features @ tile_gradient).mul_(chunk.weights)
            hidden = behind[chunk.tiles][:, None] - gained.cumsum(1)
            behind[chunk.tiles] = hidden[:, -1]
            # d loss / d log(alpha) = alpha (T g - hidden / (1 - alpha)): its own contribution less what it occludes.
            # Behind the stop, and where alpha is clamped, it is 0.
            of_log_alphas = gained.sub_(hidden.mul_(chunk.ratios))
            of_log_alphas.mul_(chunk.weights > 0).mul_(chunk.alphas < ctx.cuts.alpha_max)
            of_polynomials[chunk.rows] = of_log_alphas.flatten(0, 1) @ pixels.T
        return of_polynomials[:-1], of_features[:-1], None, None, None


def _padded(polynomials: Tensor) -> Tensor:
    """Polynomials with one more row, whose alpha is 0 everywhere. [M + 1, 6]"""
    padded = torch.nn.functional.pad(polynomials, (0, 0, 0, 1))
    padded[-1, 0] = _LOG_ZERO
    return padded


def _just_below(value: float, like: Tensor) -> float:
    """The largest number under ``value``; ``threshold`` drops what equals its bound, and a cut keeps it."""
    number = torch.tensor(value, dtype=like.dtype)
    return float(torch.nextafter(number, torch.zeros_like(number)))
