"""Stages of drawing a view, and what is common to renderers that bring their own of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.tensors import constant
from coliags_plugin.renderers.splatting import (
    CutSettings,
    is_surfels,
    output_of,
    split_channels,
)
from coliags_plugin.renderers.tiles import TileGrid, TilePairs

#: Outputs in the order of the depths of surfels.
_OF_SURFELS = ("depth_accumulated", "inverse_depth_accumulated", "distortion", "depth_median")


class SurfelRules(NamedTuple):
    """Thresholds of compositing surfels, and whether depths, their distortion and the median are wanted.

    A surfel is skipped at pixels where its z-depth is below the near plane.
    """

    cuts: CutSettings
    near_plane: float
    depths: bool


class Placed(NamedTuple):
    """N projected Gaussians or surfels and the tiles they touch.

    Attributes:
        means2d: Projected centres, pixels; its gradient is the one of ``docs/rendering.md``. [N, 2]
        columns: Tensors side by side are the table of the compositing stage, without features. [N, C] each
        depths: z-depths of the centres, scene units; 1 where not beyond the near plane. [N]
        normals: Camera axes, oriented towards the camera; may be None unless wanted. [N, 3]
        radii: Pixels, rounded up; 0 where not drawn. [N]
        pairs: Pairs of a tile and a Gaussian that is drawn and may touch it.
    """

    means2d: Float[Tensor, "N 2"]
    columns: Sequence[Float[Tensor, "N C"]]
    depths: Float[Tensor, "N"]
    normals: Float[Tensor, "N 3"] | None
    radii: Float[Tensor, "N"]
    pairs: TilePairs


class Stages(NamedTuple):
    """Projection and binning, and front-to-back compositing of the pairs of each tile, of both primitives.

    With w the weight of a Gaussian at a pixel, both compositors sum w times feature; gradients are those of the tables.

    Attributes:
        place_gaussians: From Gaussians, a camera and whether normals are wanted: columns of means2d (2), whitening (3)
            and log(opacity).
        composite_gaussians: From a table of these columns and F features for each Gaussian, and z-depths or None: image
            of sums, and of the median depth, without a gradient, or None. [N, 6 + F], [N] -> [H, W, F], [H, W]
        place_surfels: Likewise, columns of ``ProjectedSurfels.intersections`` (10), the filter's centre (2) and
            log(opacity).
        composite_surfels: From a table of these columns and F features for each surfel: image of sums; and with z its
            depth at the pixel, of sum w z, sum w / z, sum over pairs i < j of w_i w_j (1/z_i - 1/z_j)^2, and the median
            depth, 0 unless wanted. [N, 13 + F] -> [H, W, F], [H, W, 4]
    """

    place_gaussians: Callable[[Gaussians, Camera, bool, CutSettings, TileGrid], Placed]
    composite_gaussians: Callable[
        [Tensor, Tensor | None, TilePairs, TileGrid, CutSettings], tuple[Tensor, Tensor | None]
    ]
    place_surfels: Callable[[Gaussians, Camera, bool, CutSettings, TileGrid], Placed]
    composite_surfels: Callable[[Tensor, TilePairs, TileGrid, SurfelRules], tuple[Tensor, Tensor]]


def draw_view(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str],
    settings: CutSettings,
    grid: TileGrid,
    stages: Stages,
) -> RenderOutput:
    """Render 3D Gaussians, or surfels where they have two scales; see :class:`SplattingRenderer`."""
    draw = _draw_surfels if is_surfels(gaussians) else _draw_gaussians
    maps, placed = draw(gaussians, camera, wants, settings, grid, stages)
    if any(settings.background):
        maps["rgb"] = maps["rgb"] + (1 - maps["alpha"])[..., None] * constant(settings.background, maps["alpha"])
    return output_of(gaussians, camera, wants, maps, placed.means2d, placed.radii)


def _draw_gaussians(
    gaussians: Gaussians, camera: Camera, wants: Sequence[str], settings: CutSettings, grid: TileGrid, stages: Stages
) -> tuple[dict[str, Tensor], Placed]:
    placed = stages.place_gaussians(gaussians, camera, "normals" in wants, settings, grid)
    depth_channels: dict[str, Tensor] = {}
    if {"depth_accumulated", "depth_expected"} & {*wants}:
        depth_channels["depth_accumulated"] = placed.depths
    if "inverse_depth_accumulated" in wants:
        depth_channels["inverse_depth_accumulated"] = placed.depths.reciprocal()
    features = _features(gaussians, placed, depth_channels, wants)
    depths = placed.depths.detach() if "depth_median" in wants else None
    table = torch.cat([*placed.columns, *features.values()], dim=-1)
    sums, medians = stages.composite_gaussians(table, depths, placed.pairs, grid, settings)
    maps = split_channels(sums, features)
    if medians is not None:
        maps["depth_median"] = medians
    return maps, placed


def _draw_surfels(
    gaussians: Gaussians, camera: Camera, wants: Sequence[str], settings: CutSettings, grid: TileGrid, stages: Stages
) -> tuple[dict[str, Tensor], Placed]:
    placed = stages.place_surfels(gaussians, camera, "normals" in wants, settings, grid)
    features = _features(gaussians, placed, {}, wants)
    rules = SurfelRules(settings, camera.near_plane, bool({*_OF_SURFELS, "depth_expected"} & {*wants}))
    table = torch.cat([*placed.columns, *features.values()], dim=-1)
    sums, depths = stages.composite_surfels(table, placed.pairs, grid, rules)
    maps = split_channels(sums, features)
    if rules.depths:
        maps |= dict(zip(_OF_SURFELS, depths.unbind(-1), strict=True))
        # m = far / (far - near) (1 - near / z) is linear in 1 / z.
        maps["distortion"] = maps["distortion"] * settings.distortion_slope(camera.near_plane) ** 2
    return maps, placed


def _features(
    gaussians: Gaussians, placed: Placed, depth_channels: dict[str, Tensor], wants: Sequence[str]
) -> dict[str, Float[Tensor, "N C"]]:
    """Channels to composite by output: colour, 1 (its sum is alpha), some of their own, and feature channels wanted."""
    parts = {"rgb": gaussians.colors, "alpha": torch.ones_like(gaussians.opacities), **depth_channels}
    if "normals" in wants and placed.normals is not None:
        parts["normals"] = placed.normals
    parts |= {name: gaussians.features[name] for name in wants if name in gaussians.features}
    return {name: part[:, None] if part.ndim == 1 else part for name, part in parts.items()}
