"""Screen extent of surfels and their binning into tiles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.renderers.projection import filtered_covariances
from coliags_plugin.renderers.splatting import CutSettings
from coliags_plugin.renderers.surfel_projection import ProjectedSurfels
from coliags_plugin.renderers.tiles import (
    RADIUS_SLACK,
    TileGrid,
    TilePairs,
    pairs_by_tile,
    squared_distance_to_box,
    tiles_of_boxes,
)

#: Added to the squared half-axes of the ellipses, square pixels: keeps those seen nearly edge-on invertible.
_ELLIPSE_SLACK = 1e-4


@dataclass(frozen=True)
class SurfelExtents:
    """Where surfels reach alpha_min: within the image of a disc, or a circle around the centre.

    Attributes:
        ellipse_centers: Of the disc's image, pixels. [N, 2]
        covariances, whitenings: Of the ellipse, at whose rim the Mahalanobis distance is 1, as
            :class:`coliags_plugin.renderers.projection.ProjectedGaussians` has them. [N, 3], [N, 3]
        circle_centers: Pixels. [N, 2]
        squared_radii: Of the circle, square pixels. [N]
        everywhere: Whether the disc crosses the near plane: its image is no ellipse, and may be anywhere. [N]
        low, high: Corners of the bounding box; of the image where ``everywhere``. Pixels. [N, 2], [N, 2]
        drawn: Whether anything is reached. [N]
    """

    ellipse_centers: Float[Tensor, "N 2"]
    covariances: Float[Tensor, "N 3"]
    whitenings: Float[Tensor, "N 3"]
    circle_centers: Float[Tensor, "N 2"]
    squared_radii: Float[Tensor, "N"]
    everywhere: Bool[Tensor, "N"]
    low: Float[Tensor, "N 2"]
    high: Float[Tensor, "N 2"]
    drawn: Bool[Tensor, "N"]

    @property
    def radii(self) -> Float[Tensor, "N"]:
        """Half the larger edge of the bounding box in pixels, rounded up, where drawn; else 0. [N]"""
        return torch.where(self.drawn, (0.5 * (self.high - self.low)).amax(-1).ceil(), 0.0)


@torch.no_grad()
def surfel_extents(
    projected: ProjectedSurfels, opacities: Float[Tensor, "N"], camera: Camera, grid: TileGrid, settings: CutSettings
) -> SurfelExtents:
    """Compute the extent of each surfel, and whether it overlaps the rectangle of pixel centres."""
    tau = 2 * torch.log(opacities / settings.alpha_min)
    bright = projected.visible & (tau >= 0)
    level = tau.clamp_min(0) + RADIUS_SLACK
    rim = projected.tangents * level.sqrt()[:, None, None]
    x, y, z = projected.places.unbind(-1)
    # With a point of the rim at z (x/z, y/z, 1) + rim^T (cos, sin), the image is a conic: an ellipse if its z-depths,
    # within z +- |rise|, are positive.
    rise = rim[:, :, 2]
    spread = rise.norm(dim=-1)
    everywhere = z - spread <= camera.near_plane
    span = torch.where(everywhere, 1.0, (z - spread) * (z + spread))[:, None]
    row_x = camera.fx * (rim[:, :, 0] - (x / z)[:, None] * rise)
    row_y = camera.fy * (rim[:, :, 1] - (y / z)[:, None] * rise)
    along_x, along_y = ((row * rise).sum(-1, keepdim=True) / span for row in (row_x, row_y))
    bend = rise / (z[:, None] + span.sqrt())
    images = (row_x / span.sqrt() + along_x * bend, row_y / span.sqrt() + along_y * bend)
    flat_x, flat_y = (torch.nn.functional.pad(row, (0, 1)) for row in images)
    covariances, whitenings = filtered_covariances(flat_x, flat_y, _ELLIPSE_SLACK)
    ellipse_centers = projected.means2d - torch.cat([along_x, along_y], dim=-1)
    halves = covariances[:, ::2].sqrt()
    squared_radii = level * settings.surfel_filter**2
    radii = squared_radii.sqrt()[:, None]
    centers = projected.filter_centers
    low = torch.minimum(ellipse_centers - halves, centers - radii)
    high = torch.maximum(ellipse_centers + halves, centers + radii)
    size = low.new_tensor([grid.width, grid.height])
    low, high = (torch.where(everywhere[:, None], edge, box) for edge, box in ((size * 0, low), (size, high)))
    extents = SurfelExtents(
        ellipse_centers, covariances, whitenings, centers, squared_radii, everywhere, low, high, bright
    )
    overlaps = _overlaps(extents, slice(None), torch.full_like(low, 0.5), (size - 0.5).expand_as(low))
    return replace(extents, drawn=bright & overlaps)


@torch.no_grad()
def bin_surfels(projected: ProjectedSurfels, extents: SurfelExtents, grid: TileGrid) -> TilePairs:
    """Pair the drawn surfels with the tiles they reach."""
    drawn = extents.drawn.nonzero().squeeze(-1)
    drawn = drawn[torch.argsort(projected.depths[drawn], stable=True)]
    owner, column, row = tiles_of_boxes(extents.low[drawn], extents.high[drawn], grid)
    low, high = grid.boxes(column, row, extents.low.dtype)
    kept = _overlaps(extents, drawn[owner], low, high).nonzero().squeeze(-1)
    return pairs_by_tile(drawn[owner[kept]], column[kept], row[kept], grid)


def _overlaps(extents: SurfelExtents, index: Tensor | slice, low: Tensor, high: Tensor) -> Bool[Tensor, "M"]:
    """Whether surfels reach rectangles. [M], [M, 2], [M, 2]"""
    in_ellipse = squared_distance_to_box(
        extents.ellipse_centers[index], extents.covariances[index], extents.whitenings[index], low, high
    )
    centers = extents.circle_centers[index]
    to_circle = (centers - centers.maximum(low).minimum(high)).square().sum(-1)
    return extents.everywhere[index] | (in_ellipse <= 1) | (to_circle <= extents.squared_radii[index])
