"""Projection and binning of ``stages.Stages`` by triton kernels, with their gradients."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.renderers.projection import slope_limits
from coliags_plugin.renderers.splatting import CutSettings
from coliags_plugin.renderers.stages import Placed
from coliags_plugin.renderers.tiles import ELLIPSE_SLACK, RADIUS_SLACK, TileGrid, TilePairs
from coliags_plugin.renderers.triton_kernels import projection
from coliags_plugin.renderers.triton_kernels.geometry import (
    BLOCK,
    OUTLINE_COLUMNS,
    WARPS,
    Cuts,
    Extents,
    Grid,
    Projected,
    Tables,
    View,
    find_pairs,
)


def place_gaussians(
    gaussians: Gaussians, camera: Camera, with_normals: bool, cuts: CutSettings, grid: TileGrid
) -> Placed:
    """Project 3D Gaussians and bin them: :class:`~coliags_plugin.renderers.stages.Stages`."""
    means2d, whitenings, log_opacities, depths, normals, radii, outlines, boxes = _Gaussians.apply(  # type: ignore[no-untyped-call]
        *_given(gaussians, camera), camera, with_normals, cuts, grid
    )
    pairs = _pairs(depths.detach(), outlines, boxes, grid)
    return Placed(means2d, (means2d, whitenings, log_opacities[:, None]), depths, normals, radii, pairs)


def place_surfels(
    gaussians: Gaussians, camera: Camera, with_normals: bool, cuts: CutSettings, grid: TileGrid
) -> Placed:
    """Project surfels and bin them: :class:`~coliags_plugin.renderers.stages.Stages`."""
    inputs = _given(gaussians, camera)
    centers = _Centers.apply(inputs[0], inputs[4], camera)  # type: ignore[no-untyped-call]
    means2d = centers.clone()
    shapes, log_opacities, normals, depths, radii, outlines, boxes = _Surfels.apply(  # type: ignore[no-untyped-call]
        means2d, *inputs, camera, cuts, grid
    )
    pairs = _pairs(depths, outlines, boxes, grid)
    return Placed(means2d, (means2d, shapes, centers, log_opacities[:, None]), depths, normals, radii, pairs)


def _given(gaussians: Gaussians, camera: Camera) -> list[Tensor]:
    """Tensors of the Gaussians that projection reads, and the pose."""
    names = ("means", "quats_wxyz", "scales", "opacities")
    pose = camera.camera_to_world.to(gaussians.means)
    return [*(getattr(gaussians, name).contiguous() for name in names), pose.contiguous()]


class _Gaussians(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        pose: Tensor,
        camera: Camera,
        with_normals: bool,
        cuts: CutSettings,
        grid: TileGrid,
    ) -> tuple[Tensor | None, ...]:
        gaussians, extents = Tables(means, quats, scales, opacities, pose), _extents(means)
        ctx.view = _view(means, camera)
        ctx.slope_limits = (
            *slope_limits(camera.fx, camera.cx, camera.width),
            *slope_limits(camera.fy, camera.cy, camera.height),
        )
        projected = Projected(
            means.new_empty(len(means), 2),
            torch.empty_like(means),
            torch.empty_like(opacities),
            torch.empty_like(opacities),
            torch.empty_like(means) if with_normals else means,
        )
        projection.forward[_programs(len(means))](
            *(gaussians, projected, extents, ctx.view, ctx.slope_limits),
            *(Cuts(cuts.eps2d, cuts.alpha_min, RADIUS_SLACK), _grid(grid)),
            WITH_NORMALS=with_normals,
            SIZE=grid.size,
            **_OPTIONS,
        )
        ctx.with_normals = with_normals
        ctx.save_for_backward(*gaussians, projected.shapes, extents.boxes)
        ctx.mark_non_differentiable(*extents)
        normals = projected.normals if with_normals else None
        return projected.means2d, projected.shapes, projected.log_opacities, projected.depths, normals, *extents

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        of_means2d: Tensor,
        of_whitenings: Tensor,
        of_log_opacities: Tensor,
        of_depths: Tensor,
        of_normals: Tensor | None,
        *_: Tensor,
    ) -> tuple[Tensor | None, ...]:
        *tables, whitenings, boxes = ctx.saved_tensors
        gaussians = Tables(*tables)
        of_gaussians = Tables(*[*map(torch.empty_like, tables[:4]), _pose_sums(gaussians.means)])
        gradients = (of_means2d, of_whitenings, of_depths, of_log_opacities, of_normals)
        of_projected = Projected(*_contiguous(*gradients, otherwise=gaussians.means))
        projection.backward[_programs(len(gaussians.means))](
            *(gaussians, whitenings, boxes, of_projected, of_gaussians, ctx.view, ctx.slope_limits),
            WITH_NORMALS=ctx.with_normals,
            **_OPTIONS,
        )
        return *of_gaussians[:4], _of_pose(of_gaussians.pose), None, None, None, None


class _Centers(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        ctx.save_for_backward(means, pose)
        ctx.view = _view(means, camera)
        means2d = means.new_empty(len(means), 2)
        projection.centers[_programs(len(means))](means, pose, means2d, ctx.view, **_OPTIONS)
        return means2d

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_means2d: Tensor) -> tuple[Tensor | None, ...]:
        means, pose = ctx.saved_tensors
        of_means, of_pose = torch.empty_like(means), _pose_sums(means, torch.float64)
        projection.centers_backward[_programs(len(means))](
            means, pose, of_means2d.contiguous(), of_means, of_pose, ctx.view, **_OPTIONS
        )
        return of_means, _of_pose(of_pose), None


class _Surfels(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        pose: Tensor,
        camera: Camera,
        cuts: CutSettings,
        grid: TileGrid,
    ) -> tuple[Tensor, ...]:
        surfels, extents = Tables(means, quats, scales, opacities, pose), _extents(means)
        ctx.view = _view(means, camera)
        projected = Projected(
            means2d,
            means.new_empty(len(means), projection.SHAPE_COLUMNS.value),
            torch.empty_like(opacities),
            torch.empty_like(opacities),
            torch.empty_like(means),
        )
        limits = Cuts(ELLIPSE_SLACK, cuts.alpha_min, RADIUS_SLACK, cuts.surfel_filter)
        projection.surfels_forward[_programs(len(means))](
            surfels, projected, extents, ctx.view, limits, _grid(grid), SIZE=grid.size, **_OPTIONS
        )
        ctx.save_for_backward(*surfels, extents.boxes)
        ctx.mark_non_differentiable(projected.depths, *extents)
        return projected.shapes, projected.log_opacities, projected.normals, projected.depths, *extents

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, of_shapes: Tensor, of_log_opacities: Tensor, of_normals: Tensor, *_: Tensor
    ) -> tuple[Tensor | None, ...]:
        *tables, boxes = ctx.saved_tensors
        surfels = Tables(*tables)
        of_surfels = Tables(*[*map(torch.empty_like, tables[:4]), _pose_sums(surfels.means, torch.float64)])
        of_means2d = surfels.means.new_empty(len(surfels.means), 2)
        # Centres and depths have gradients of their own.
        gradients = (None, of_shapes, None, of_log_opacities, of_normals)
        of_projected = Projected(*_contiguous(*gradients, otherwise=surfels.means))
        projection.surfels_backward[_programs(len(of_means2d))](
            surfels, boxes, of_projected, of_means2d, of_surfels, ctx.view, **_OPTIONS
        )
        return of_means2d, *of_surfels[:4], _of_pose(of_surfels.pose), None, None, None


#: Options of every launch here. Fused multiply-adds are no less accurate.
_OPTIONS = {"BLOCK": BLOCK, "num_warps": WARPS, "enable_fp_fusion": True}


def _programs(count: int) -> tuple[int]:
    return (-(-count // BLOCK),)


def _view(means: Tensor, camera: Camera) -> View:
    return View(len(means), camera.fx, camera.fy, camera.cx, camera.cy, camera.near_plane)


def _grid(grid: TileGrid) -> Grid:
    return Grid(grid.width, grid.height, grid.columns, grid.rows)


def _extents(means: Tensor) -> Extents:
    """Extents to be written."""
    count = len(means)
    boxes = torch.empty(count, 4, dtype=torch.int32, device=means.device)
    return Extents(means.new_empty(count), means.new_empty(count, OUTLINE_COLUMNS.value), boxes)


def _contiguous(*gradients: Tensor | None, otherwise: Tensor) -> Iterable[Tensor]:
    return (otherwise if gradient is None else gradient.contiguous() for gradient in gradients)


def _pose_sums(means: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Room for each program's sums, so that their total does not depend on the order in which programs end."""
    return means.new_empty(*_programs(len(means)), 12, dtype=dtype)


def _of_pose(sums: Float[Tensor, "P 12"]) -> Float[Tensor, "4 4"]:
    upper = sums.sum(0).view(3, 4).float()
    return torch.cat([upper, torch.zeros_like(upper[:1])])


def _pairs(
    depths: Float[Tensor, "N"], outlines: Float[Tensor, "N C"], boxes: Float[Tensor, "N 4"], grid: TileGrid
) -> TilePairs:
    """Pairs by tile and front to back. The host waits for their number."""
    count, device = len(depths), depths.device
    counts = torch.empty(count, dtype=torch.int32, device=device)
    order = depths.argsort(stable=True)
    options = {"SIZE": grid.size, **_OPTIONS}
    launch, tables = find_pairs[_programs(count)], (outlines, boxes, order, counts)
    unused = (counts, counts, counts)
    launch(*tables, *unused, count, grid.columns, EMIT=False, **options)
    ends = counts[order].cumsum(0)
    total = int(ends[-1]) if count else 0
    gaussian = torch.zeros(total, dtype=torch.int32, device=device)
    tiles = torch.full_like(gaussian, grid.columns * grid.rows)
    launch(*tables, ends, gaussian, tiles, count, grid.columns, EMIT=True, **options)
    tile, place = torch.sort(tiles, stable=True)
    of_tiles = torch.arange(grid.columns * grid.rows + 1, dtype=tile.dtype, device=device)
    return TilePairs(gaussian=gaussian[place], tile=tile, starts=torch.searchsorted(tile, of_tiles))
