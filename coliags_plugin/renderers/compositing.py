"""Front-to-back alpha compositing of 2D Gaussians and of surfels, tile by tile.

The recursion and its derivative are written out in ``docs/rendering.md``, sections "Compositing" and "Surfels". Two
properties make plain tensor operations fast. Within a tile the logarithm of a Gaussian's alpha is a quadratic
polynomial of the pixel position, so all pixels of all pairs come from one matrix product with six monomials, and the
gradients of the six coefficients from its transpose. And the backward pass sweeps front to back once more instead of
storing anything per pixel and pair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.renderers.splatting import CutSettings
from coliags_plugin.renderers.stages import SurfelRules
from coliags_plugin.renderers.tiles import TileGrid, TilePairs

#: Elements of the largest temporary tensors, by device type: to fit the L2 caches, or to fill the device.
CHUNK_ELEMENTS = {"cpu": 2**18, "cuda": 2**24}
#: Finite stand-in for log(0), far below every alpha_min.
_LOG_ZERO = -1e4
#: Fewest and most pairs of one tile composited at a time.
_MIN_RANKS, _MAX_RANKS = 32, 128

Evaluated = TypeVar("Evaluated")


@dataclass(frozen=True)
class Chunk(Generic[Evaluated]):
    """C consecutive pairs of each of G tiles, at all P pixels."""

    tiles: Int[Tensor, "G"]  # which tiles, no two the same
    rows: Int[Tensor, "GC"]  # index of each pair in the list of pairs; M, one past its end, where a tile has fewer
    before: Float[Tensor, "G P"]  # transmittance in front of the chunk; 0 where compositing has stopped
    transmittances: Float[Tensor, "G C P"]  # the same behind each pair
    alphas: Float[Tensor, "G C P"]
    ratios: Float[Tensor, "G C P"]  # alpha / (1 - alpha)
    weights: Float[Tensor, "G C P"]  # alpha times the transmittance in front of the pair
    evaluated: Evaluated  # what else came with the alphas

    def rows_of(self, padded: Float[Tensor, "M+1 F"]) -> Float[Tensor, "G C F"]:
        """The rows of a table that belong to the pairs. [M + 1, F] -> [G, C, F]"""
        return padded.index_select(0, self.rows).view(*self.weights.shape[:2], -1)

    def of_log_alphas(
        self, gained: Float[Tensor, "G C P"], behind: Float[Tensor, "tiles P"], alpha_max: float
    ) -> Float[Tensor, "R P"]:
        """Derivatives of the loss with respect to log(alpha): own contribution less what it occludes.

        Behind the stop, and where alpha is clamped, they are 0. ``gained`` is the first-order contribution of each pair
        and is overwritten; ``behind`` is that of all pairs not yet swept, and is reduced by this chunk's.
        """
        hidden = behind[self.tiles][:, None] - gained.cumsum(1)
        behind[self.tiles] = hidden[:, -1]
        # d loss / d log(alpha) = alpha (T g - hidden / (1 - alpha))
        result = gained.sub_(hidden.mul_(self.ratios))
        return result.mul_(self.weights > 0).mul_(self.alphas < alpha_max).flatten(0, 1)


def sweep(
    evaluate: Callable[[Int[Tensor, "R"]], tuple[Float[Tensor, "R P"], Evaluated]],
    starts: Int[Tensor, "tiles+1"],
    ones: Float[Tensor, "P"],
    cuts: CutSettings,
) -> Iterator[Chunk[Evaluated]]:
    """Iterate over every tile's pairs front to back until they end or no pixel has transmittance left.

    ``evaluate`` gives alphas of pairs at the pixels of their tiles before clamping and cut-off, in a tensor that may be
    overwritten, and what else the caller wants of these pairs; the alpha of row M, one past the end, must be 0.
    ``starts`` is the first pair of each tile, and M; ``ones`` is 1 for each pixel of a tile, of the result's dtype and
    device.
    """
    budget = CHUNK_ELEMENTS.get(ones.device.type, CHUNK_ELEMENTS["cuda"]) // len(ones)
    alpha_below = _just_below(cuts.alpha_min, ones)
    transmittance_below = _just_below(cuts.transmittance_min, ones)
    # Tiles with similar numbers of pairs are grouped, so that few rows are padding.
    counts, occupied = starts.diff().sort(descending=True, stable=True)
    occupied = occupied[: int((counts > 0).sum())]
    padding = int(starts[-1])
    for group in torch.split(occupied, max(1, budget // _MIN_RANKS)):
        tiles = group
        first, end = starts[tiles], starts[tiles + 1]
        before = ones.expand(len(tiles), -1)
        while len(tiles):
            longest = int((end - first).max())
            ranks = min(longest, _MAX_RANKS, max(_MIN_RANKS, budget // len(tiles)))
            rows = first[:, None] + torch.arange(ranks, device=first.device)
            rows = torch.where(rows < end[:, None], rows, padding).flatten()
            flat, evaluated = evaluate(rows)
            alphas = flat.view(len(tiles), ranks, -1).clamp_(max=cuts.alpha_max)
            torch.threshold_(alphas, alpha_below, 0.0)
            through = 1 - alphas
            ratios = alphas / through
            through[:, 0] *= before
            transmittances = through.cumprod_(1)
            # Transmittance only falls, so setting it to zero below the bound stops compositing for good.
            torch.threshold_(transmittances, transmittance_below, 0.0)
            # alpha T in front = alpha / (1 - alpha) T behind, which is 0 for the pair that would cross the bound.
            weights = ratios * transmittances
            yield Chunk(tiles, rows, before, transmittances, alphas, ratios, weights, evaluated)
            before = transmittances[:, -1].clone()
            first = first + ranks
            alive = (first < end) & (before.amax(-1) > 0)
            if not bool(alive.all()):
                tiles, first, end, before = tiles[alive], first[alive], end[alive], before[alive]


def padded_rows(rows: Float[Tensor, "M K"], log_alpha: int) -> Float[Tensor, "M+1 K"]:
    """Rows with one more, whose alpha is 0 everywhere: column ``log_alpha`` is added to its logarithm. [M + 1, K]"""
    padded = torch.nn.functional.pad(rows, (0, 0, 0, 1))
    padded[-1, log_alpha] = _LOG_ZERO
    return padded


def crossing_of_half(chunk: Chunk[Evaluated]) -> tuple[Int[Tensor, "G P"], Bool[Tensor, "G P"]]:
    """Index of the pair that brings the transmittance to one half or less, and whether one does. [G, P], [G, P]"""
    crossing = (chunk.transmittances > 0.5).sum(1, keepdim=True).clamp_max(chunk.weights.shape[1] - 1)
    crosses = (chunk.before > 0.5) & (chunk.transmittances.gather(1, crossing).squeeze(1) <= 0.5)
    return crossing.squeeze(1), crosses & (chunk.weights.gather(1, crossing).squeeze(1) > 0)


def _just_below(value: float, like: Tensor) -> float:
    """The largest number under ``value``; ``threshold`` drops what equals its bound, and a cut keeps it."""
    number = torch.tensor(value, dtype=like.dtype)
    return float(torch.nextafter(number, torch.zeros_like(number)))


# --- 3D Gaussians -----------------------------------------------------------------------------------------------------


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
    of_depths = None if depths is None else depths[pairs.gaussian]
    composited, medians = _Composite.apply(polynomials, of_pairs[:, 6:], of_depths, pairs.starts, pixels, cuts)  # type: ignore[no-untyped-call]
    return grid.to_image(composited), None if medians is None else grid.to_image(medians[:, None])[..., 0]


def _sweep_gaussians(padded: Tensor, starts: Tensor, pixels: Tensor, cuts: CutSettings) -> Iterator[Chunk[None]]:
    """Sweep over the pairs of all tiles, the polynomials padded. [M + 1, 6], [tiles + 1], [6, P]"""

    def evaluate(rows: Tensor) -> tuple[Tensor, None]:
        return (padded.index_select(0, rows) @ pixels).exp_(), None

    return sweep(evaluate, starts, padded.new_ones(pixels.shape[1]), cuts)


class _Composite(torch.autograd.Function):
    """Sum of weight times feature over the pairs of each tile, [tiles, F, P], and median depth, [tiles, P], or None."""

    @staticmethod
    def forward(
        ctx: Any,
        polynomials: Tensor,
        features: Tensor,
        depths: Tensor | None,
        starts: Tensor,
        pixels: Tensor,
        cuts: CutSettings,
    ) -> tuple[Tensor, Tensor | None]:
        padded, padded_features = padded_rows(polynomials, 0), torch.nn.functional.pad(features, (0, 0, 0, 1))
        composited = features.new_zeros(len(starts) - 1, features.shape[1], pixels.shape[1])
        medians = None if depths is None else depths.new_zeros(len(starts) - 1, pixels.shape[1])
        for chunk in _sweep_gaussians(padded, starts, pixels, cuts):
            composited[chunk.tiles] += chunk.rows_of(padded_features).mT @ chunk.weights
            if depths is not None and medians is not None:
                crossing, crosses = crossing_of_half(chunk)
                rows = chunk.rows.view(chunk.weights.shape[:2]).gather(1, crossing).clamp_max(len(depths) - 1)
                medians[chunk.tiles] += torch.where(crosses, depths[rows], 0.0)
        ctx.save_for_backward(padded, padded_features, starts, pixels, composited)
        ctx.cuts = cuts
        if medians is not None:
            ctx.mark_non_differentiable(medians)
        return composited, medians

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
        padded, padded_features, starts, pixels, composited = ctx.saved_tensors
        of_polynomials, of_features = torch.zeros_like(padded), torch.zeros_like(padded_features)
        gradient = gradient.contiguous()
        # First-order contribution to the loss of the pairs not yet swept.
        behind = (composited * gradient).sum(1)
        for chunk in _sweep_gaussians(padded, starts, pixels, ctx.cuts):
            tile_gradient = gradient[chunk.tiles]
            of_features[chunk.rows] = (chunk.weights @ tile_gradient.mT).flatten(0, 1)
            gained = (chunk.rows_of(padded_features) @ tile_gradient).mul_(chunk.weights)
            of_polynomials[chunk.rows] = chunk.of_log_alphas(gained, behind, ctx.cuts.alpha_max) @ pixels.T
        return of_polynomials[:-1], of_features[:-1], None, None, None, None


# --- surfels ----------------------------------------------------------------------------------------------------------


def composite_surfels(
    table: Float[Tensor, "N 13+F"], pairs: TilePairs, grid: TileGrid, rules: SurfelRules
) -> tuple[Float[Tensor, "H W F"], Float[Tensor, "H W 4"]]:
    """Composite the pairs of each tile: :class:`~coliags_plugin.renderers.stages.Stages`."""
    of_pairs = table.index_select(0, pairs.gaussian)
    origins = grid.centers(pairs.tile, of_pairs.dtype)
    rows = _pair_rows(of_pairs[:, :10], of_pairs[:, 10:12], of_pairs[:, 12:13], origins)
    pixels = torch.nn.functional.pad(grid.offsets(rows), (1, 0), value=1.0).T.contiguous()
    sums, depths = _CompositeSurfels.apply(rows, of_pairs[:, 13:], pairs.starts, pixels, rules)  # type: ignore[no-untyped-call]
    return grid.to_image(sums), grid.to_image(depths)


def _pair_rows(
    intersections: Float[Tensor, "M 10"],
    filter_centers: Float[Tensor, "M 2"],
    log_opacities: Float[Tensor, "M 1"],
    origins: Float[Tensor, "M 2"],
) -> Float[Tensor, "M 13"]:
    """Coefficients of U, V and W in 1, x, y of the offset from the tile's midpoint, and what else pixels depend on.

    That is D, the offset from the midpoint to the filter's centre, and log(opacity). ``origins`` are the midpoints of
    the tiles, pixels; ``intersections`` those of ``ProjectedSurfels`` for each pair's surfel.
    """
    slopes = intersections[:, 2:8].reshape(-1, 3, 2)
    at_center, plane_offsets = intersections[:, 8], intersections[:, 9:]
    constants = (slopes * (origins - intersections[:, :2])[:, None]).sum(-1)
    # At its projected centre a surfel has U = V = 0 exactly.
    constants = constants + torch.nn.functional.pad(at_center[:, None], (2, 0))
    planes = torch.cat([constants[..., None], slopes], dim=-1).flatten(1)
    return torch.cat([planes, plane_offsets, filter_centers - origins, log_opacities], dim=-1)


class _Hits(NamedTuple):
    """Intersections of the rays of a tile's P pixels with R surfels; all finite.

    A ray misses where W is 0, or the intersection is nearer than the near plane.
    """

    inverse_w: Float[Tensor, "R P"]  # 1 / W; 0 where missed
    u: Float[Tensor, "R P"]  # intersection in standard deviations; 0 where missed
    v: Float[Tensor, "R P"]
    depths: Float[Tensor, "R P"]  # z-depth; 1 where missed
    on_disc: Bool[Tensor, "R P"]  # whether u^2 + v^2 counts, else the low-pass filter
    from_center: tuple[Float[Tensor, "R P"], Float[Tensor, "R P"]]  # offset from the filter's centre, pixels


def _sweep_surfels(padded: Tensor, starts: Tensor, pixels: Tensor, rules: SurfelRules) -> Iterator[Chunk[_Hits]]:
    """Sweep over the pairs of all tiles, the rows padded. [M + 1, 13], [tiles + 1], [3, P]"""

    def evaluate(rows: Tensor) -> tuple[Tensor, _Hits]:
        table = padded.index_select(0, rows)
        u, v, w = (table[:, :9].reshape(-1, 3) @ pixels).view(len(rows), 3, -1).unbind(1)
        inverse_w = w.reciprocal()
        depths = table[:, 9:10] * inverse_w
        # Infinite, or NaN, where W is 0.
        hit = (depths >= rules.near_plane) & (depths < torch.inf)
        inverse_w = torch.where(hit, inverse_w, 0.0)
        u, v = u * inverse_w, v * inverse_w
        x, y = pixels[1] - table[:, 10:11], pixels[2] - table[:, 11:12]
        squared = u * u + v * v
        filtered = (x * x + y * y) * rules.cuts.surfel_filter**-2
        on_disc = squared <= filtered
        alphas = torch.exp(table[:, 12:] - 0.5 * torch.where(on_disc, squared, filtered)).mul_(hit)
        return alphas, _Hits(inverse_w, u, v, torch.where(hit, depths, 1.0), on_disc, (x, y))

    return sweep(evaluate, starts, padded.new_ones(pixels.shape[1]), rules.cuts)


class _Spread:
    """Running weight, mean and sum of squared differences of 1/z over the surfels swept so far, per tile and pixel.

    Merging means and squared differences, rather than differences of large sums, keeps float32 accurate for surfels
    close to each other.
    """

    def __init__(self, like: Float[Tensor, "tiles P"]) -> None:
        self.weight, self.mean, self.squares = (torch.zeros_like(like) for _ in range(3))

    def add(self, tiles: Int[Tensor, "G"], weights: Float[Tensor, "G C P"], values: Float[Tensor, "G C P"]) -> None:
        """Merge the surfels of a chunk."""
        weight, before = weights.sum(1), self.weight[tiles]
        mean = (weights * values).sum(1) / torch.where(weight > 0, weight, 1.0)
        squares = (weights * (values - mean[:, None]).square()).sum(1)
        step = (mean - self.mean[tiles]) * (weight / torch.where(weight > 0, before + weight, 1.0))
        self.squares[tiles] += squares + before * step * (mean - self.mean[tiles])
        self.mean[tiles] += step
        self.weight[tiles] = before + weight


class _CompositeSurfels(torch.autograd.Function):
    """Sums of weight times feature, [tiles, F, P], and of depths as in ``stages.Stages``, [tiles, 4, P]."""

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, features: Tensor, starts: Tensor, pixels: Tensor, rules: SurfelRules
    ) -> tuple[Tensor, Tensor]:
        padded, padded_features = padded_rows(rows, -1), torch.nn.functional.pad(features, (0, 0, 0, 1))
        tiles = len(starts) - 1
        sums = features.new_zeros(tiles, features.shape[1], pixels.shape[1])
        depths = features.new_zeros(tiles, 4, pixels.shape[1])
        spread = _Spread(depths[:, 0])
        for chunk in _sweep_surfels(padded, starts, pixels, rules):
            sums[chunk.tiles] += chunk.rows_of(padded_features).mT @ chunk.weights
            if rules.depths:
                z = chunk.evaluated.depths.view_as(chunk.weights)
                crossing, crosses = crossing_of_half(chunk)
                median = z.gather(1, crossing[:, None]).squeeze(1) * crosses
                over_z = chunk.weights / z
                depths[chunk.tiles] += torch.stack(
                    [(chunk.weights * z).sum(1), over_z.sum(1), torch.zeros_like(median), median], dim=1
                )
                spread.add(chunk.tiles, chunk.weights, z.reciprocal())
        depths[:, 2] = spread.weight * spread.squares
        ctx.save_for_backward(
            padded, padded_features, starts, pixels, sums, depths, spread.weight, spread.mean, spread.squares
        )
        ctx.rules = rules
        return sums, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_sums: Tensor, of_depths: Tensor) -> tuple[Tensor | None, ...]:
        padded, padded_features, starts, pixels, sums, depths, weight, mean, squares = ctx.saved_tensors
        rules: SurfelRules = ctx.rules
        of_rows, of_features = torch.zeros_like(padded), torch.zeros_like(padded_features)
        of_sums, of_depths = of_sums.contiguous(), of_depths.contiguous()
        # First-order contribution to the loss of the pairs not yet swept; the third sum is quadratic in the weights.
        behind = (sums * of_sums).sum(1)
        if rules.depths:
            behind += (
                depths[:, 0] * of_depths[:, 0] + depths[:, 1] * of_depths[:, 1] + 2 * depths[:, 2] * of_depths[:, 2]
            )
        for chunk in _sweep_surfels(padded, starts, pixels, rules):
            weights, hits = chunk.weights, chunk.evaluated
            of_tile = of_sums[chunk.tiles]
            of_features[chunk.rows] = (weights @ of_tile.mT).flatten(0, 1)
            gained = chunk.rows_of(padded_features) @ of_tile
            of_z = None
            if rules.depths:
                of_accumulated, of_inverse, of_spread, of_median = of_depths[chunk.tiles][:, :, None].unbind(1)
                z = hits.depths.view_as(weights)
                over_z = z.reciprocal()
                total, deviation = weight[chunk.tiles][:, None], over_z - mean[chunk.tiles][:, None]
                gained += of_accumulated * z + of_inverse * over_z
                gained += of_spread * (total * deviation.square() + squares[chunk.tiles][:, None])
                of_over_z = of_inverse + 2 * of_spread * total * deviation
                of_z = weights * (of_accumulated - of_over_z * over_z.square())
                crossing, crosses = crossing_of_half(chunk)
                of_z.scatter_add_(1, crossing[:, None], of_median * crosses[:, None])
            gained.mul_(weights)
            of_log_alphas = chunk.of_log_alphas(gained, behind, rules.cuts.alpha_max)
            of_rows[chunk.rows] = _of_rows(
                hits, of_log_alphas, None if of_z is None else of_z.flatten(0, 1), pixels, rules
            )
        return of_rows[:-1], of_features[:-1], None, None, None


def _of_rows(
    hits: _Hits,
    of_log_alphas: Float[Tensor, "R P"],
    of_z: Float[Tensor, "R P"] | None,
    pixels: Tensor,
    rules: SurfelRules,
) -> Float[Tensor, "R 13"]:
    """Gradients of :func:`_pair_rows` from those of the logarithms of alpha and of z, with z = D / W. [R, 13]"""
    on_disc = of_log_alphas * hits.on_disc * hits.inverse_w
    of_u, of_v = -on_disc * hits.u, -on_disc * hits.v
    of_w = -(of_u * hits.u + of_v * hits.v)
    of_offset = torch.zeros_like(of_w[:, :1])
    if of_z is not None:
        of_offsets = of_z * hits.inverse_w
        of_w = of_w - of_offsets * hits.depths
        of_offset = of_offsets.sum(1, keepdim=True)
    of_planes = torch.stack([of_u, of_v, of_w], dim=1) @ pixels.T
    filtered = of_log_alphas * ~hits.on_disc * rules.cuts.surfel_filter**-2
    of_center = torch.stack([(filtered * offset).sum(1) for offset in hits.from_center], dim=1)
    return torch.cat([of_planes.flatten(1), of_offset, of_center, of_log_alphas.sum(1, keepdim=True)], dim=1)
