"""Gaussian splatting in plain PyTorch, the reference that all other backends are tested against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import pydantic
import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Availability
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.renderers.checks import check_gaussian_outputs, is_surfels
from coliags_plugin.renderers.compositing import composite, log_alpha_polynomials, median_depths, monomials
from coliags_plugin.renderers.projection import facing_normals, project_gaussians
from coliags_plugin.renderers.splatting import CutSettings, DrawnView, SplattingRenderer, split_channels
from coliags_plugin.renderers.surfel_compositing import SurfelRules, composite_surfels, pair_rows
from coliags_plugin.renderers.surfel_projection import project_surfels
from coliags_plugin.renderers.tiles import TileGrid, bin_gaussians, bin_surfels, gaussian_extents, surfel_extents

#: Outputs in the order of the depths of :func:`composite_surfels`.
_OF_SURFELS = ("depth_accumulated", "inverse_depth_accumulated", "distortion", "depth_median")


class TorchRendererSettings(CutSettings):
    """Options of :class:`TorchRenderer`."""

    tile_size: int = pydantic.Field(default=8, ge=1)
    """Edge of a tile, pixels. Changes the speed, and the result by rounding only."""


class TorchRenderer(SplattingRenderer[TorchRendererSettings]):
    """Reference renderer of 3D Gaussians and surfels, on any device, in float32 or float64: ``docs/rendering.md``."""

    Settings = TorchRendererSettings
    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d", "surfels"})
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})
    name: ClassVar[str] = "torch"

    @classmethod
    def availability(cls) -> Availability:
        """Always available: PyTorch only."""
        return Availability(True, "plain PyTorch, runs wherever PyTorch does")

    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """See :func:`render_gaussians`."""
        return render_gaussians(gaussians, camera, wants, self.settings)


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str] = ("rgb", "alpha"),
    settings: TorchRendererSettings | None = None,
) -> RenderOutput:
    """Render 3D Gaussians, or surfels where they have two scales, from a camera, in their dtype and on their device.

    Everything but ``radii`` and, of 3D Gaussians, ``depth_median`` is differentiable, once, in the Gaussians and in
    ``camera.camera_to_world``; ``means2d.grad`` is set by ``backward``.

    Raises:
        InputError: An output is unknown or not of these Gaussians, or they have neither two nor three scales.
    """
    settings = settings or TorchRendererSettings()
    check_gaussian_outputs(wants, gaussians)
    draw = _draw_surfels if is_surfels(gaussians) else _draw_gaussians
    return draw(gaussians, camera, wants, settings).output(gaussians, camera, wants)


def _draw_gaussians(
    gaussians: Gaussians, camera: Camera, wants: Sequence[str], settings: TorchRendererSettings
) -> DrawnView:
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    projected = project_gaussians(gaussians, camera, settings.eps2d)
    extents = gaussian_extents(projected, gaussians.opacities, grid, settings.alpha_min)
    pairs = bin_gaussians(projected, extents, grid)

    # One table and one lookup: the gradient of a lookup is the most expensive step outside compositing.
    opacities = torch.where(extents.drawn, gaussians.opacities, 1.0)
    own: dict[str, Tensor] = {}
    if {"depth_accumulated", "depth_expected"} & {*wants}:
        own["depth_accumulated"] = projected.depths
    if "inverse_depth_accumulated" in wants:
        own["inverse_depth_accumulated"] = projected.depths.reciprocal()
    if "normals" in wants:
        own["normals"] = facing_normals(projected, gaussians.scales)
    features = _features(gaussians, own, wants)
    table = torch.cat([projected.means2d, projected.whitenings, opacities.log()[:, None], *features.values()], dim=-1)
    of_pairs = table.index_select(0, pairs.gaussian)
    offsets = grid.centers(pairs.tile, table.dtype) - of_pairs[:, :2]
    polynomials = log_alpha_polynomials(of_pairs[:, 5], of_pairs[:, 2:5], offsets)
    pixels = monomials(grid.offsets(table))
    sums = grid.to_image(composite(polynomials, of_pairs[:, 6:], pairs.starts, pixels, settings))
    maps = split_channels(sums, features)
    if "depth_median" in wants:
        medians = median_depths(polynomials, projected.depths.detach()[pairs.gaussian], pairs.starts, pixels, settings)
        maps["depth_median"] = grid.to_image(medians[:, None])[..., 0]
    radii = torch.where(extents.drawn, extents.halves.amax(-1).ceil(), 0.0)
    return _over_background(maps, projected.means2d, radii, settings)


def _draw_surfels(
    gaussians: Gaussians, camera: Camera, wants: Sequence[str], settings: TorchRendererSettings
) -> DrawnView:
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    projected = project_surfels(gaussians, camera)
    extents = surfel_extents(projected, gaussians.opacities, camera, grid, settings)
    pairs = bin_surfels(projected, extents, grid)

    opacities = torch.where(extents.drawn, gaussians.opacities, 1.0)
    features = _features(gaussians, {"normals": projected.normals} if "normals" in wants else {}, wants)
    of_surfels = [projected.intersections, projected.filter_centers, opacities.log()[:, None], *features.values()]
    of_pairs = torch.cat(of_surfels, dim=-1).index_select(0, pairs.gaussian)
    origins = grid.centers(pairs.tile, of_pairs.dtype)
    rows = pair_rows(of_pairs[:, :10], of_pairs[:, 10:12], of_pairs[:, 12], origins)
    rules = SurfelRules(settings, camera.near_plane, bool({*_OF_SURFELS, "depth_expected"} & {*wants}))
    sums, depths = composite_surfels(rows, of_pairs[:, 13:], pairs, grid.offsets(rows), rules)
    maps = split_channels(grid.to_image(sums), features)
    if rules.depths:
        maps |= dict(zip(_OF_SURFELS, grid.to_image(depths).unbind(-1), strict=True))
        # m = far / (far - near) (1 - near / z) is linear in 1 / z.
        maps["distortion"] = maps["distortion"] * settings.distortion_slope(camera.near_plane) ** 2
    return _over_background(maps, projected.means2d, extents.radii, settings)


def _over_background(
    maps: dict[str, Tensor], means2d: Tensor, radii: Tensor, settings: TorchRendererSettings
) -> DrawnView:
    alpha = maps["alpha"]
    rgb = maps["rgb"] + (1 - alpha)[..., None] * alpha.new_tensor(settings.background)
    return DrawnView(rgb, alpha, maps, means2d, radii)


def _features(gaussians: Gaussians, own: dict[str, Tensor], wants: Sequence[str]) -> dict[str, Float[Tensor, "N C"]]:
    """Channels to composite by output: colour, 1 (its sum is alpha), some of their own, and feature channels wanted."""
    parts = {"rgb": gaussians.colors, "alpha": torch.ones_like(gaussians.opacities), **own}
    parts |= {name: gaussians.features[name] for name in wants if name in gaussians.features}
    return {name: part[:, None] if part.ndim == 1 else part for name, part in parts.items()}
