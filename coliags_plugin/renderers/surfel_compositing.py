"""Front-to-back alpha compositing of surfels, tile by tile, with a depth of their own at every pixel.

The definition and its derivatives are written out in ``docs/rendering.md``, section "Surfels". As for 3D Gaussians
(``compositing.py``), the backward pass sweeps front to back once more instead of storing anything per pixel and pair.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.renderers.stages import SurfelRules
from coliags_plugin.renderers.sweeping import Chunk, crossing_of_half, padded_rows, sweep
from coliags_plugin.renderers.tiles import TileGrid, TilePairs


def composite_surfels(
    table: Float[Tensor, "N 13+F"], pairs: TilePairs, grid: TileGrid, rules: SurfelRules
) -> tuple[Float[Tensor, "H W F"], Float[Tensor, "H W 4"]]:
    """Composite the pairs of each tile: :class:`~coliags_plugin.renderers.stages.Stages`."""
    of_pairs = table.index_select(0, pairs.gaussian)
    origins = grid.centers(pairs.tile, of_pairs.dtype)
    rows = pair_rows(of_pairs[:, :10], of_pairs[:, 10:12], of_pairs[:, 12], origins)
    sums, depths = composite_pairs(rows, of_pairs[:, 13:], pairs, grid.offsets(rows), rules)
    return grid.to_image(sums), grid.to_image(depths)


def pair_rows(
    intersections: Float[Tensor, "M 10"],
    filter_centers: Float[Tensor, "M 2"],
    log_opacities: Float[Tensor, "M"],
    origins: Float[Tensor, "M 2"],
) -> Float[Tensor, "M 13"]:
    """Input rows of :func:`composite_pairs`, from the ``ProjectedSurfels.intersections`` of each pair's surfel.

    These are the coefficients of U, V and W in 1, x, y of the offset from the tile's midpoint, D, the offset from there
    to the filter's centre, and log(opacity). ``origins`` are the midpoints of the tiles, pixels.
    """
    slopes = intersections[:, 2:8].reshape(-1, 3, 2)
    at_center, plane_offsets = intersections[:, 8], intersections[:, 9:]
    constants = (slopes * (origins - intersections[:, :2])[:, None]).sum(-1)
    # At its projected centre a surfel has U = V = 0 exactly.
    constants = constants + torch.nn.functional.pad(at_center[:, None], (2, 0))
    planes = torch.cat([constants[..., None], slopes], dim=-1).flatten(1)
    return torch.cat([planes, plane_offsets, filter_centers - origins, log_opacities[:, None]], dim=-1)


def composite_pairs(
    rows: Float[Tensor, "M 13"],
    features: Float[Tensor, "M F"],
    pairs: TilePairs,
    offsets: Float[Tensor, "P 2"],
    rules: SurfelRules,
) -> tuple[Float[Tensor, "tiles F P"], Float[Tensor, "tiles 4 P"]]:
    """Composite the pairs of each tile at each of its pixels; differentiable (once) in ``rows`` and ``features``.

    ``rows`` are of :func:`pair_rows`, by tile and front to back; ``offsets`` lead from a tile's midpoint to its pixel
    centres. With w the weight of a surfel at a pixel and z its depth there, the result is sum w f, and sum w z,
    sum w / z, sum over pairs i < j of w_i w_j (1/z_i - 1/z_j)^2, and the median depth, 0 unless wanted.
    """
    pixels = torch.nn.functional.pad(offsets, (1, 0), value=1.0).T.contiguous()
    composited: tuple[Tensor, Tensor] = _CompositeSurfels.apply(rows, features, pairs.starts, pixels, rules)  # type: ignore[no-untyped-call]
    return composited


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


def _sweep(padded: Tensor, starts: Tensor, pixels: Tensor, rules: SurfelRules) -> Iterator[Chunk[_Hits]]:
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
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, features: Tensor, starts: Tensor, pixels: Tensor, rules: SurfelRules
    ) -> tuple[Tensor, Tensor]:
        padded, padded_features = padded_rows(rows, -1), torch.nn.functional.pad(features, (0, 0, 0, 1))
        tiles = len(starts) - 1
        sums = features.new_zeros(tiles, features.shape[1], pixels.shape[1])
        depths = features.new_zeros(tiles, 4, pixels.shape[1])
        spread = _Spread(depths[:, 0])
        for chunk in _sweep(padded, starts, pixels, rules):
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
        for chunk in _sweep(padded, starts, pixels, rules):
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
    """Gradients of :func:`pair_rows` from those of the logarithms of alpha and of z, with z = D / W. [R, 13]"""
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
