"""Screen extent of Gaussians and surfels, and their binning into image tiles, front to back.

Tiles only save work and do not change the result, because the pairs kept here are a superset of the (pixel, Gaussian)
pairs with alpha >= alpha_min, and compositing tests each of those again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.renderers.projection import ProjectedGaussians, ProjectedSurfels, filtered_covariances
from coliags_plugin.renderers.splatting import CutSettings

#: Slack on the squared Mahalanobis radius, so that rounding here never drops a pixel that compositing would draw.
RADIUS_SLACK = 1e-2
#: Added to the squared half-axes of the ellipses, square pixels: keeps those seen nearly edge-on invertible.
ELLIPSE_SLACK = 1e-4


@dataclass(frozen=True)
class TileGrid:
    """An image in square tiles of ``size`` pixels, row by row; the last column and row may extend beyond its edge."""

    width: int
    height: int
    size: int

    @property
    def columns(self) -> int:
        """Number of tile columns."""
        return -(-self.width // self.size)

    @property
    def rows(self) -> int:
        """Number of tile rows."""
        return -(-self.height // self.size)

    def centers(self, tiles: Int[Tensor, "M"], dtype: torch.dtype) -> Float[Tensor, "M 2"]:
        """Midpoints of tiles, pixels. [M, 2]"""
        corner = torch.stack([tiles % self.columns, tiles // self.columns], dim=-1)
        return corner.to(dtype) * self.size + 0.5 * self.size

    def offsets(self, like: Tensor) -> Float[Tensor, "P 2"]:
        """Pixel centres of a tile, row by row, from its midpoint; dtype and device as ``like``. [P, 2]"""
        axis = torch.arange(self.size, dtype=like.dtype, device=like.device) + 0.5 - 0.5 * self.size
        return torch.stack([axis.repeat(self.size), axis.repeat_interleave(self.size)], dim=-1)

    def boxes(
        self, column: Int[Tensor, "M"], row: Int[Tensor, "M"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2"]]:
        """Corners of the rectangles of pixel centres of tiles. [M, 2], [M, 2]"""
        low = torch.stack([column, row], dim=-1).to(dtype) * self.size + 0.5
        return low, low + (self.size - 1)

    def to_image(self, values: Float[Tensor, "tiles F P"]) -> Float[Tensor, "H W F"]:
        """Assemble tiles into an image, cropped to its size. [H, W, F]"""
        split = values.view(self.rows, self.columns, -1, self.size, self.size)
        whole = split.permute(0, 3, 1, 4, 2).reshape(self.rows * self.size, self.columns * self.size, -1)
        return whole[: self.height, : self.width]


@dataclass(frozen=True)
class TilePairs:
    """The M pairs of a tile and a Gaussian that may touch it, by tile and within a tile front to back.

    ``starts`` is the first pair of each tile, and M at the end.
    """

    gaussian: Int[Tensor, "M"]
    tile: Int[Tensor, "M"]
    starts: Int[Tensor, "tiles+1"]


@dataclass(frozen=True)
class Extents:
    """Bounds, pixels, of where Gaussians reach alpha_min: ellipses of these covariances, up to a Mahalanobis distance.

    Covariances and whitenings are as :class:`ProjectedGaussians` has them.
    """

    centers: Float[Tensor, "N 2"]
    covariances: Float[Tensor, "N 3"]
    whitenings: Float[Tensor, "N 3"]
    squared_rims: Float[Tensor, "N"]  # squared Mahalanobis distance at the rim
    low: Float[Tensor, "N 2"]  # corners of the bounding box
    high: Float[Tensor, "N 2"]
    radii: Float[Tensor, "N"]  # half the larger edge of the bounding box, rounded up, where drawn; else 0
    drawn: Bool[Tensor, "N"]  # whether anything of the rectangle of pixel centres is reached

    def reaches(
        self, index: Tensor | slice, low: Float[Tensor, "M 2"], high: Float[Tensor, "M 2"]
    ) -> Bool[Tensor, "M"]:
        """True where Gaussians of these indices reach rectangles. [M]"""
        ellipses = (self.centers[index], self.covariances[index], self.whitenings[index])
        return _squared_distance_to_box(*ellipses, low, high) <= self.squared_rims[index]


@torch.no_grad()
def gaussian_extents(
    projected: ProjectedGaussians, opacities: Float[Tensor, "N"], grid: TileGrid, alpha_min: float
) -> Extents:
    """Compute the extent of each Gaussian, with some slack, and whether it overlaps the image, without."""
    tau = 2 * torch.log(opacities / alpha_min)
    ellipses, variances = (
        (projected.means2d, projected.covariances, projected.whitenings),
        projected.covariances[:, ::2],
    )
    edge = torch.full_like(projected.means2d, 0.5)
    size = edge.new_tensor([grid.width, grid.height]).expand_as(edge)
    drawn = projected.in_front & (tau >= 0) & (_squared_distance_to_box(*ellipses, edge, size - edge) <= tau)
    radii = torch.where(drawn, (tau.clamp_min(0)[:, None] * variances).sqrt().amax(-1).ceil(), 0.0)
    rims = tau + RADIUS_SLACK
    halves = (rims[:, None] * variances).sqrt()
    return Extents(*ellipses, rims, projected.means2d - halves, projected.means2d + halves, radii, drawn)


@dataclass(frozen=True)
class SurfelExtents(Extents):
    """Extents of surfels: within the image of a disc, an ellipse, or a circle around the centre."""

    circle_centers: Float[Tensor, "N 2"]
    squared_radii: Float[Tensor, "N"]  # of the circles
    #: Whether the disc crosses the near plane: its image is no ellipse, and may be anywhere; so is the bounding box.
    everywhere: Bool[Tensor, "N"]

    def reaches(
        self, index: Tensor | slice, low: Float[Tensor, "M 2"], high: Float[Tensor, "M 2"]
    ) -> Bool[Tensor, "M"]:
        """True where surfels of these indices reach rectangles. [M]"""
        centers = self.circle_centers[index]
        to_circle = (centers - centers.maximum(low).minimum(high)).square().sum(-1)
        in_circle = to_circle <= self.squared_radii[index]
        return self.everywhere[index] | super().reaches(index, low, high) | in_circle


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
    covariances, whitenings = filtered_covariances(flat_x, flat_y, ELLIPSE_SLACK)
    ellipse_centers = projected.means2d - torch.cat([along_x, along_y], dim=-1)
    halves = covariances[:, ::2].sqrt()
    squared_radii = level * settings.surfel_filter**2
    radii = squared_radii.sqrt()[:, None]
    centers = projected.filter_centers
    low = torch.minimum(ellipse_centers - halves, centers - radii)
    high = torch.maximum(ellipse_centers + halves, centers + radii)
    size = low.new_tensor([grid.width, grid.height])
    low, high = (torch.where(everywhere[:, None], edge, box) for edge, box in ((size * 0, low), (size, high)))
    ellipses = (ellipse_centers, covariances, whitenings, torch.ones_like(tau))
    circles = (centers, squared_radii, everywhere)
    extents = SurfelExtents(*ellipses, low, high, (0.5 * (high - low)).amax(-1).ceil(), bright, *circles)
    drawn = bright & extents.reaches(slice(None), torch.full_like(low, 0.5), (size - 0.5).expand_as(low))
    return replace(extents, radii=torch.where(drawn, extents.radii, 0.0), drawn=drawn)


@torch.no_grad()
def bin_extents(extents: Extents, depths: Float[Tensor, "N"], grid: TileGrid) -> TilePairs:
    """Pair what is drawn with the tiles that it reaches."""
    drawn = extents.drawn.nonzero().squeeze(-1)
    # Sorting once by depth and stably by tile afterwards leaves every tile's list front to back; Gaussians of equal
    # depth keep the order they came in.
    drawn = drawn[torch.argsort(depths[drawn], stable=True)]
    owner, column, row = _tiles_of_boxes(extents.low[drawn], extents.high[drawn], grid)
    low, high = grid.boxes(column, row, extents.low.dtype)
    touching = extents.reaches(drawn[owner], low, high).nonzero().squeeze(-1)
    tile, order = torch.sort((row * grid.columns + column)[touching], stable=True)
    starts = torch.searchsorted(tile, torch.arange(grid.columns * grid.rows + 1, dtype=tile.dtype, device=tile.device))
    return TilePairs(gaussian=drawn[owner[touching[order]]], tile=tile.long(), starts=starts)


def _tiles_of_boxes(
    low: Float[Tensor, "N 2"], high: Float[Tensor, "N 2"], grid: TileGrid
) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"], Int[Tensor, "M"]]:
    """Pairs of a box and a tile that it touches, in the order of the boxes: index of the box, column and row.

    ``low`` and ``high`` are the boxes' corners in pixels. A box beside the image is assigned to tiles at its edge.
    """
    last = low.new_tensor([grid.columns - 1, grid.rows - 1])
    first_tile = (low / grid.size).floor().clamp_min(0).minimum(last).long()
    last_tile = (high / grid.size).floor().clamp_min(0).minimum(last).long()
    across, down = (last_tile - first_tile + 1).unbind(-1)

    counts = across * down
    owner = torch.repeat_interleave(counts)
    place = torch.arange(len(owner), device=owner.device) - (counts.cumsum(0) - counts)[owner]
    # Narrow integers: this division, and the sort by tile, are several times as fast on them.
    place, across_of_owner = place.int(), across.int()[owner]
    row = torch.div(place, across_of_owner, rounding_mode="floor")
    column = place - row * across_of_owner + first_tile[:, 0].int()[owner]
    return owner, column, row + first_tile[:, 1].int()[owner]


def _squared_distance_to_box(
    means2d: Float[Tensor, "M 2"],
    covariances: Float[Tensor, "M 3"],
    whitenings: Float[Tensor, "M 3"],
    low: Float[Tensor, "M 2"],
    high: Float[Tensor, "M 2"],
) -> Float[Tensor, "M"]:
    """Exact smallest squared Mahalanobis distance from a Gaussian's centre to an axis-aligned box. [M]

    A convex quadratic has its minimum over a box at the centre if that is inside, else on an edge that faces it; along
    the edge of given dx the best dy is dx * cov_xy / cov_xx, clamped to the edge's ends (and likewise with x and y
    exchanged).
    """
    below, above = (low - means2d).unbind(-1), (high - means2d).unbind(-1)
    xx, xy, yy = covariances.unbind(-1)
    u_xx, u_yx, u_yy = whitenings.unbind(-1)

    def squared(dx: Tensor, dy: Tensor) -> Tensor:
        return (u_xx * dx).square() + (u_yx * dx + u_yy * dy).square()

    facing_x = below[0].clamp_min(0) + above[0].clamp_max(0)
    facing_y = below[1].clamp_min(0) + above[1].clamp_max(0)
    along_y = (facing_x * xy / xx).clamp(below[1], above[1])
    along_x = (facing_y * xy / yy).clamp(below[0], above[0])
    return torch.minimum(squared(facing_x, along_y), squared(along_x, facing_y))
