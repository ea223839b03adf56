"""Gaussian splatting in plain PyTorch, the reference that all other backends are tested against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pydantic
import torch
from torch import Tensor

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.renderers.compositing import composite_gaussians, composite_surfels
from coliags_plugin.renderers.projection import facing_normals, project_gaussians, project_surfels
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer
from coliags_plugin.renderers.stages import Placed, Stages, draw_view
from coliags_plugin.renderers.tiles import TileGrid, bin_extents, gaussian_extents, surfel_extents


class TorchRendererSettings(CutSettings):
    """Options of :class:`TorchRenderer`."""

    tile_size: int = pydantic.Field(default=8, ge=1)
    """Edge of a tile, pixels. Changes the speed, and the result by rounding only."""


class TorchRenderer(SplattingRenderer[TorchRendererSettings]):
    """Reference renderer of 3D Gaussians and surfels, on any device, in float32 or float64: ``docs/rendering.md``."""

    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})
    name: ClassVar[str] = "torch"

    @classmethod
    def availability(cls) -> Availability:
        """Always available: PyTorch only."""
        return Availability(True, "plain PyTorch, runs wherever PyTorch does")

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Draw Gaussians, in their dtype and on their device."""
        self.check_gaussian_outputs(wants, gaussians)
        grid = TileGrid(camera.width, camera.height, self.settings.tile_size)
        return draw_view(gaussians, camera, wants, self.settings, grid, _STAGES)


def _place_gaussians(
    gaussians: Gaussians, camera: Camera, with_normals: bool, settings: CutSettings, grid: TileGrid
) -> Placed:
    projected = project_gaussians(gaussians, camera, settings.eps2d)
    extents = gaussian_extents(projected, gaussians.opacities, grid, settings.alpha_min)
    columns = (projected.means2d, projected.whitenings, _log_opacities(gaussians, extents.drawn))
    normals = facing_normals(projected, gaussians.scales) if with_normals else None
    pairs = bin_extents(extents, projected.depths, grid)
    return Placed(projected.means2d, columns, projected.depths, normals, extents.radii, pairs)


def _place_surfels(
    gaussians: Gaussians, camera: Camera, with_normals: bool, settings: CutSettings, grid: TileGrid
) -> Placed:
    projected = project_surfels(gaussians, camera)
    extents = surfel_extents(projected, gaussians.opacities, camera, grid, settings)
    columns = (projected.intersections, projected.filter_centers, _log_opacities(gaussians, extents.drawn))
    pairs = bin_extents(extents, projected.depths, grid)
    return Placed(projected.means2d, columns, projected.depths, projected.normals, extents.radii, pairs)


def _log_opacities(gaussians: Gaussians, drawn: Tensor) -> Tensor:
    """Logarithms of opacities, 0 where not drawn. [N, 1]"""
    return torch.where(drawn, gaussians.opacities, 1.0).log()[:, None]


_STAGES = Stages(_place_gaussians, composite_gaussians, _place_surfels, composite_surfels)
