"""Stages of drawing a view in plain PyTorch, on any device; only compositing is a renderer's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.renderers.checks import check_gaussian_outputs, is_surfels
from coliags_plugin.renderers.projection import facing_normals, project_gaussians
from coliags_plugin.renderers.splatting import CutSettings, DrawnView, split_channels
from coliags_plugin.renderers.surfel_projection import project_surfels
from coliags_plugin.renderers.tiles import (
    TileGrid,
    TilePairs,
    bin_gaussians,
    bin_surfels,
    gaussian_extents,
    surfel_extents,
)

#: Outputs in the order of the depths of surfels.
_OF_SURFELS = ("depth_accumulated", "inverse_depth_accumulated", "distortion", "depth_median")


class SurfelRules(NamedTuple):
    """Thresholds of compositing surfels, and whether depths, their distortion and the median are wanted.

    A surfel is skipped at pixels where its z-depth is below the near plane.
    """

    cuts: CutSettings
    near_plane: float
    depths: bool


class Compositors(NamedTuple):
    """Front-to-back compositing of the pairs of each tile, of both primitives.

    With w the weight of a Gaussian at a pixel, both sum w times feature; derivatives are with respect to the tables.

    Attributes:
        gaussians: From a table of means2d (2), whitening (3), log(opacity) and F features for each Gaussian, and
            z-depths or None: image of sums, and of the median depth, without a derivative, or None.
            [N, 6 + F], [N] -> [H, W, F], [H, W]
        surfels: From a table of ``ProjectedSurfels.intersections`` (10), the filter's centre (2), log(opacity) and F
            features for each surfel: image of sums; and with z its depth at the pixel, of sum w z, sum w / z, sum over
            pairs i < j of w_i w_j (1/z_i - 1/z_j)^2, and the median depth, 0 unless wanted. [N, 13 + F] -> [H, W, F],
            [H, W, 4]
    """

    gaussians: Callable[[Tensor, Tensor | None, TilePairs, TileGrid, CutSettings], tuple[Tensor, Tensor | None]]
    surfels: Callable[[Tensor, TilePairs, TileGrid, SurfelRules], tuple[Tensor, Tensor]]


def draw_view(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str],
    settings: CutSettings,
    grid: TileGrid,
    compositors: Compositors,
) -> RenderOutput:
    """Render 3D Gaussians, or surfels where they have two scales; see :func:`torch_renderer.render_gaussians`."""
    check_gaussian_outputs(wants, gaussians)
    draw = _draw_surfels if is_surfels(gaussians) else _draw_gaussians
    return draw(gaussians, camera, wants, settings, grid, compositors).output(gaussians, camera, wants)


def _draw_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str],
    settings: CutSettings,
    grid: TileGrid,
    compositors: Compositors,
) -> DrawnView:
    projected = project_gaussians(gaussians, camera, settings.eps2d)
    extents = gaussian_extents(projected, gaussians.opacities, grid, settings.alpha_min)
    pairs = bin_gaussians(projected, extents, grid)

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
    depths = projected.depths.detach() if "depth_median" in wants else None
    sums, medians = compositors.gaussians(table, depths, pairs, grid, settings)
    maps = split_channels(sums, features)
    if medians is not None:
        maps["depth_median"] = medians
    radii = torch.where(extents.drawn, extents.halves.amax(-1).ceil(), 0.0)
    return _over_background(maps, projected.means2d, radii, settings)


def _draw_surfels(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str],
    settings: CutSettings,
    grid: TileGrid,
    compositors: Compositors,
) -> DrawnView:
    projected = project_surfels(gaussians, camera)
    extents = surfel_extents(projected, gaussians.opacities, camera, grid, settings)
    pairs = bin_surfels(projected, extents, grid)

    opacities = torch.where(extents.drawn, gaussians.opacities, 1.0)
    features = _features(gaussians, {"normals": projected.normals} if "normals" in wants else {}, wants)
    of_surfels = [projected.intersections, projected.filter_centers, opacities.log()[:, None], *features.values()]
    rules = SurfelRules(settings, camera.near_plane, bool({*_OF_SURFELS, "depth_expected"} & {*wants}))
    sums, depths = compositors.surfels(torch.cat(of_surfels, dim=-1), pairs, grid, rules)
    maps = split_channels(sums, features)
    if rules.depths:
        maps |= dict(zip(_OF_SURFELS, depths.unbind(-1), strict=True))
        # m = far / (far - near) (1 - near / z) is linear in 1 / z.
        maps["distortion"] = maps["distortion"] * settings.distortion_slope(camera.near_plane) ** 2
    return _over_background(maps, projected.means2d, extents.radii, settings)


def _over_background(maps: dict[str, Tensor], means2d: Tensor, radii: Tensor, settings: CutSettings) -> DrawnView:
    alpha = maps["alpha"]
    rgb = maps["rgb"] + (1 - alpha)[..., None] * alpha.new_tensor(settings.background)
    return DrawnView(rgb, alpha, maps, means2d, radii)


def _features(gaussians: Gaussians, own: dict[str, Tensor], wants: Sequence[str]) -> dict[str, Float[Tensor, "N C"]]:
    """Channels to composite by output: colour, 1 (its sum is alpha), some of their own, and feature channels wanted."""
    parts = {"rgb": gaussians.colors, "alpha": torch.ones_like(gaussians.opacities), **own}
    parts |= {name: gaussians.features[name] for name in wants if name in gaussians.features}
    return {name: part[:, None] if part.ndim == 1 else part for name, part in parts.items()}
