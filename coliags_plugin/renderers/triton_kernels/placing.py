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
from coliags_plugin.renderers.triton_kernels import projection, surfel_projection
from coliags_plugin.renderers.triton_kernels.binning import find_pairs
from coliags_plugin.renderers.triton_kernels.geometry import BLOCK, OUTLINE_COLUMNS, WARPS


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
    given = _given(gaussians, camera)
    centers = _Centers.apply(given[0], given[4], camera)  # type: ignore[no-untyped-call]
    means2d = centers.clone()
    shapes, log_opacities, normals, depths, radii, outlines, boxes = _Surfels.apply(  # type: ignore[no-untyped-call]
        means2d, *given, camera, cuts, grid
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
        given = (means, quats, scales, opacities, pose)
        limits = slope_limits(camera.fx, camera.cx, camera.width), slope_limits(camera.fy, camera.cy, camera.height)
        ctx.view = (len(means), camera.fx, camera.fy, camera.near_plane, *limits[0], *limits[1])
        means2d, whitenings = means.new_empty(len(means), 2), torch.empty_like(means)
        log_opacities, depths = torch.empty_like(opacities), torch.empty_like(opacities)
        normals = torch.empty_like(means) if with_normals else None
        extents = _extents(means)
        outputs = (means2d, whitenings, depths, log_opacities, means if normals is None else normals)
        count, fx, fy, *rest = ctx.view
        projection.forward[_programs(count)](
            *(*given, *outputs, *extents, count, fx, fy, camera.cx, camera.cy, *rest, cuts.eps2d, cuts.alpha_min),
            *(RADIUS_SLACK, grid.width, grid.height, grid.columns, grid.rows),
            WITH_NORMALS=with_normals,
            SIZE=grid.size,
            **_OPTIONS,
        )
        ctx.with_normals = with_normals
        ctx.save_for_backward(*given, whitenings, extents[2])
        ctx.mark_non_differentiable(*extents)
        return means2d, whitenings, log_opacities, depths, normals, *extents

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
        saved = ctx.saved_tensors
        means = saved[0]
        found = [torch.empty_like(tensor) for tensor in saved[:4]]
        of_pose = _pose_sums(means)
        outer = _contiguous(of_means2d, of_whitenings, of_depths, of_log_opacities, of_normals, otherwise=means)
        projection.backward[_programs(len(means))](
            *(*saved, *outer, *found, of_pose, *ctx.view), WITH_NORMALS=ctx.with_normals, **_OPTIONS
        )
        return *found, _of_pose(of_pose), None, None, None, None


class _Centers(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, pose: Tensor, camera: Camera) -> Tensor:
        ctx.save_for_backward(means, pose)
        ctx.view = (len(means), camera.fx, camera.fy, camera.near_plane)
        means2d = means.new_empty(len(means), 2)
        count, fx, fy, near_plane = ctx.view
        surfel_projection.centers[_programs(count)](
            means, pose, means2d, count, fx, fy, camera.cx, camera.cy, near_plane, **_OPTIONS
        )
        return means2d

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_means2d: Tensor) -> tuple[Tensor | None, ...]:
        means, pose = ctx.saved_tensors
        of_means, of_pose = torch.empty_like(means), _pose_sums(means, torch.float64)
        surfel_projection.centers_backward[_programs(len(means))](
            means, pose, of_means2d.contiguous(), of_means, of_pose, *ctx.view, **_OPTIONS
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
        given = (means, quats, scales, opacities, pose)
        ctx.view = (len(means), camera.fx, camera.fy, camera.near_plane)
        shapes = means.new_empty(len(means), surfel_projection.SHAPE_COLUMNS.value)
        depths, log_opacities = torch.empty_like(opacities), torch.empty_like(opacities)
        normals, extents = torch.empty_like(means), _extents(means)
        surfel_projection.forward[_programs(len(means))](
            *(*given, means2d, shapes, depths, log_opacities, normals, *extents, *ctx.view, cuts.alpha_min),
            *(RADIUS_SLACK, ELLIPSE_SLACK, cuts.surfel_filter, grid.width, grid.height, grid.columns, grid.rows),
            SIZE=grid.size,
            **_OPTIONS,
        )
        ctx.save_for_backward(*given, extents[2])
        ctx.mark_non_differentiable(depths, *extents)
        return shapes, log_opacities, normals, depths, *extents

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, of_shapes: Tensor, of_log_opacities: Tensor, of_normals: Tensor, *_: Tensor
    ) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        means = saved[0]
        found = [means.new_empty(len(means), 2), *(torch.empty_like(tensor) for tensor in saved[:4])]
        of_pose = _pose_sums(means, torch.float64)
        outer = _contiguous(of_shapes, of_log_opacities, of_normals, otherwise=means)
        surfel_projection.backward[_programs(len(means))](*saved, *outer, *found, of_pose, *ctx.view, **_OPTIONS)
        return *found, _of_pose(of_pose), None, None, None


#: Options of every launch here. Fused multiply-adds are no less accurate.
_OPTIONS = {"BLOCK": BLOCK, "num_warps": WARPS, "enable_fp_fusion": True}


def _programs(count: int) -> tuple[int]:
    return (-(-count // BLOCK),)


def _extents(means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Radii, outlines and boxes of tiles, to be written."""
    count = len(means)
    boxes = torch.empty(count, 4, dtype=torch.int32, device=means.device)
    return means.new_empty(count), means.new_empty(count, OUTLINE_COLUMNS.value), boxes


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
    launch, given = find_pairs[_programs(count)], (outlines, boxes, order, counts)
    unused = (counts, counts, counts)
    launch(*given, *unused, count, grid.columns, EMIT=False, **options)
    ends = counts[order].cumsum(0)
    total = int(ends[-1]) if count else 0
    gaussian = torch.zeros(total, dtype=torch.int32, device=device)
    tiles = torch.full_like(gaussian, grid.columns * grid.rows)
    launch(*given, ends, gaussian, tiles, count, grid.columns, EMIT=True, **options)
    tile, place = torch.sort(tiles, stable=True)
    of_tiles = torch.arange(grid.columns * grid.rows + 1, dtype=tile.dtype, device=device)
    return TilePairs(gaussian=gaussian[place], tile=tile, starts=torch.searchsorted(tile, of_tiles))
