"""Compositing of ``stages.Stages`` by triton kernels, with its gradients."""

from __future__ import annotations

from typing import Any

import torch
import triton
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.renderers.splatting import CutSettings
from coliags_plugin.renderers.stages import SurfelRules
from coliags_plugin.renderers.tiles import TileGrid, TilePairs
from coliags_plugin.renderers.triton_kernels import sweeps


def composite_gaussians(
    table: Float[Tensor, "N 6+F"],
    depths: Float[Tensor, "N"] | None,
    pairs: TilePairs,
    grid: TileGrid,
    cuts: CutSettings,
) -> tuple[Float[Tensor, "H W F"], Float[Tensor, "H W"] | None]:
    """Composite the pairs of each tile: :class:`~coliags_plugin.renderers.stages.Stages`."""
    image, medians = _Gaussians.apply(table, depths, pairs, grid, cuts)  # type: ignore[no-untyped-call]
    return image.permute(1, 2, 0), medians


def composite_surfels(
    table: Float[Tensor, "N 13+F"], pairs: TilePairs, grid: TileGrid, rules: SurfelRules
) -> tuple[Float[Tensor, "H W F"], Float[Tensor, "H W 4"]]:
    """Composite the pairs of each tile: :class:`~coliags_plugin.renderers.stages.Stages`."""
    image, depths = _Surfels.apply(table, pairs, grid, rules)  # type: ignore[no-untyped-call]
    return image.permute(1, 2, 0), depths.permute(1, 2, 0)


class _Gaussians(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, table: Tensor, depths: Tensor | None, pairs: TilePairs, grid: TileGrid, cuts: CutSettings
    ) -> tuple[Tensor, Tensor | None]:
        table = table.contiguous()
        image = table.new_empty(table.shape[1] - sweeps.GAUSSIAN_COLUMNS.value, grid.height, grid.width)
        medians = None if depths is None else table.new_empty(grid.height, grid.width)
        unused = table if depths is None else depths.contiguous()
        sweeps.gaussians_forward[(grid.columns * grid.rows,)](
            *(table, unused, pairs.gaussian, pairs.starts, image, unused if medians is None else medians),
            *_sizes(grid, image),
            *_bounds(cuts),
            WITH_MEDIANS=medians is not None,
            **_blocks(image, grid, sweeps.FORWARD_WARPS),
        )
        ctx.save_for_backward(table, image)
        ctx.drawn = pairs, grid, cuts
        if medians is not None:
            ctx.mark_non_differentiable(medians)
        return image, medians

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_image: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
        table, image = ctx.saved_tensors
        pairs, grid, cuts = ctx.drawn
        of_table = torch.zeros_like(table)
        sweeps.gaussians_backward[(grid.columns * grid.rows,)](
            *(table, pairs.gaussian, pairs.starts, image, of_image.contiguous(), of_table),
            *_sizes(grid, image),
            *_bounds(cuts),
            **_blocks(image, grid, sweeps.BACKWARD_WARPS),
        )
        return of_table, None, None, None, None


class _Surfels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, pairs: TilePairs, grid: TileGrid, rules: SurfelRules) -> tuple[Tensor, Tensor]:
        table = table.contiguous()
        image = table.new_empty(table.shape[1] - sweeps.SURFEL_COLUMNS.value, grid.height, grid.width)
        depths, spread = (table.new_zeros(count, grid.height, grid.width) for count in (4, 3))
        sweeps.surfels_forward[(grid.columns * grid.rows,)](
            *(table, pairs.gaussian, pairs.starts, image, depths, spread),
            *_sizes(grid, image),
            *_surfel_bounds(rules),
            WITH_DEPTHS=rules.depths,
            **_blocks(image, grid, sweeps.FORWARD_WARPS),
        )
        ctx.save_for_backward(table, image, depths, spread)
        ctx.drawn = pairs, grid, rules
        return image, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_image: Tensor, of_depths: Tensor) -> tuple[Tensor | None, ...]:
        table, image, depths, spread = ctx.saved_tensors
        pairs, grid, rules = ctx.drawn
        of_table = torch.zeros_like(table)
        sweeps.surfels_backward[(grid.columns * grid.rows,)](
            *(table, pairs.gaussian, pairs.starts, image, depths, spread),
            *(of_image.contiguous(), of_depths.contiguous(), of_table),
            *_sizes(grid, image),
            *_surfel_bounds(rules),
            WITH_DEPTHS=rules.depths,
            **_blocks(image, grid, sweeps.BACKWARD_WARPS),
        )
        return of_table, None, None, None


def _sizes(grid: TileGrid, image: Tensor) -> tuple[int, int, int, int]:
    return grid.columns, grid.width, grid.height, len(image)


def _bounds(cuts: CutSettings) -> tuple[float, float, float]:
    return cuts.alpha_min, cuts.alpha_max, cuts.transmittance_min


def _blocks(image: Tensor, grid: TileGrid, warps: int) -> dict[str, int]:
    """Sizes of the kernels' blocks, and options of the compiler."""
    channels = max(16, triton.next_power_of_2(len(image)))
    return {
        "CHANNELS": channels,
        "SIZE": grid.size,
        "RANKS": sweeps.RANKS,
        "num_warps": warps,
        "enable_fp_fusion": True,
    }


def _surfel_bounds(rules: SurfelRules) -> tuple[float, ...]:
    return *_bounds(rules.cuts), rules.near_plane, rules.cuts.surfel_filter**-2
