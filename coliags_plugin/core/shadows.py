"""Shadows of a lamp beside the lens: a soft shadow map of what the camera sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import nnls
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.tensors import fit_kernels, tables

#: Opacity from which on what is drawn casts shadows.
OPAQUE = 0.2
#: Relative thickness of the nearest layer in a cell, of which the surface is the weighted mean.
LAYER = 1.1
#: How far behind that surface, relative to its depth, a place begins to be in shadow, and is wholly.
SHADOW = (0.05, 0.09)
#: Largest half width of a footprint, and width of the map's border around the image, pixels.
REACH, BORDER = 4.0, 8


@torch.no_grad()
def lit_shares(
    positions: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    sizes: Float[Tensor, "N"],
    camera: Camera,
    lamp: Float[Tensor, "3"],
) -> Float[Tensor, "N"]:
    """Share of a lamp's light that reaches each of the places that a camera sees, from 0 to 1, without gradient.

    The map is the camera's image, seen from the lamp. A place covers the cells, a pixel wide, whose centres are within
    its size along both axes, or else the cell that it is in. The surface of a cell is the mean depth, weighted by
    opacity, of the places within :data:`LAYER` of the nearest; a place is lit where it is not behind the surfaces of
    the four cells around it, interpolated bilinearly. Outside the map, and where it has no surface, everything is lit.

    Args:
        positions: World frame, scene units. [N, 3]
        opacities: In [0, 1]; of :data:`OPAQUE` or less casts no shadow. [N]
        sizes: Half widths, scene units. [N]
        camera: The camera.
        lamp: Position of the lamp, camera axes, scene units. [3]
    """
    rotation = camera.camera_to_world[:3, :3].to(positions)
    seen = (positions - camera.center.to(positions)) @ rotation - lamp.to(positions)
    if not fit_kernels(seen):
        return _lit_shares(seen, opacities, sizes, camera)
    from coliags_plugin.core.numba_kernels.shadows import draw_and_compare
    from coliags_plugin.core.numba_kernels.threads import Crew

    view = np.array([camera.fx, camera.fy, camera.cx, camera.cy, OPAQUE, LAYER, *SHADOW, REACH], np.float32)
    surface = np.empty((camera.height + 2 * BORDER, camera.width + 2 * BORDER), np.float32)
    shares = torch.empty_like(sizes)
    Crew().run(draw_and_compare, *tables(seen, opacities, sizes), view, BORDER, surface, *tables(shares))
    return shares


def _lit_shares(
    seen: Float[Tensor, "N 3"], opacities: Float[Tensor, "N"], sizes: Float[Tensor, "N"], camera: Camera
) -> Float[Tensor, "N"]:
    """Definition of the shares, of places in the axes of a camera at the lamp."""
    rows, columns = camera.height + 2 * BORDER, camera.width + 2 * BORDER
    depth = seen[:, 2]
    ahead = depth > 0
    safe = torch.where(ahead, depth, 1.0)
    row = camera.fy * seen[:, 1] / safe + (camera.cy + BORDER - 0.5)  # cell centres are at integers
    column = camera.fx * seen[:, 0] / safe + (camera.cx + BORDER - 0.5)

    # What casts shadows covers the cells from top to bottom and left to right, listed one footprint after the other.
    reach = (camera.fx * sizes / safe).clamp_max(REACH)
    (top, bottom), (left, right) = _range(row, reach, rows), _range(column, reach, columns)
    casts = ahead & (opacities > OPAQUE) & (bottom >= top) & (right >= left)
    counts = torch.where(casts, (bottom - top + 1) * (right - left + 1), 0.0).long()
    caster = torch.arange(len(depth), device=depth.device).repeat_interleave(counts)
    place = torch.arange(len(caster), device=depth.device) - (counts.cumsum(0) - counts)[caster]
    width = (right - left + 1)[caster].long()
    cell = (top[caster].long() + place // width) * columns + left[caster].long() + place % width

    drawn = depth[caster]
    nearest = torch.full((rows * columns,), torch.inf).to(seen).scatter_reduce(0, cell, drawn, "amin")
    weights = torch.where(drawn < LAYER * nearest[cell], opacities[caster], 0.0)
    total, weighted = (torch.zeros_like(nearest).index_add(0, cell, values) for values in (weights, weights * drawn))
    surface = torch.where(total > 0, weighted / total, torch.inf)

    above, before = row.floor(), column.floor()
    inside = ahead & (above >= 0) & (before >= 0) & (above < rows - 1) & (before < columns - 1)
    corner = torch.where(inside, above * columns + before, 0.0).long()
    down, across = row - above, column - before
    lit = torch.zeros_like(depth)
    for step, share in (
        (0, (1 - down) * (1 - across)),
        (1, (1 - down) * across),
        (columns, down * (1 - across)),
        (columns + 1, down * across),
    ):
        behind = depth / surface[corner + step] - 1.0
        lit += share * ((SHADOW[1] - behind) / (SHADOW[1] - SHADOW[0])).clamp(0.0, 1.0)
    return torch.where(inside, lit, 1.0)


def _range(
    centre: Float[Tensor, "N"], reach: Float[Tensor, "N"], cells: int
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """First and last of the map's cells within a reach of a centre, or the nearest cell; first > last: none."""
    first, last = (centre - reach).ceil(), (centre + reach).floor()
    first, last = (torch.where(last < first, centre.round(), end) for end in (first, last))
    return first.clamp_min(0), last.clamp_max(cells - 1)


#: Distances from the lens, as shares of the scene's, and numbers of the lamps that are tried first; the step in which
#: they are then moved, and that to which it is halved.
_RINGS, _STEP, _LAST_STEP = ((0.05, 6), (0.09, 9), (0.13, 12)), 0.03, 0.006
_MOVES = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
#: Most lamps; least share of the squared residuals that each must explain, and of the colours that it must have.
MOST_LAMPS, _EXPLAINED, _LEAST = 3, 0.05, 0.05
#: Approximate number of frames and of pixels of a frame that are looked at; fewest lit observations of a point.
_FRAMES, _PIXELS, _FEWEST = 28, 20_000, 3


def find_lamps(
    frames: Sequence[Frame],
    residuals: Float[Tensor, "P F"],
    usable: Bool[Tensor, "P F"],
    sights: Float[Tensor, "P F 3"],
    distance: float,
) -> Float[Tensor, "K 4"]:
    """Lamps beside the lens that explain where surface points are darker than in other frames: up to three, or none.

    A point that a lamp of share w does not reach is darker by w, relative to frames in which every lamp that is tried
    reaches it. One lamp after the other is taken from rings about the lens and moved until the squared residuals of a
    fit of all shares, none of them negative (NNLS), fall no more.

    Args:
        frames: Training frames with depth. F
        residuals: Logarithms of the points' colours, less all that is explained without shadows. [P, F]
        usable: Which of them count. [P, F]
        sights: Positions of the points in camera axes, scene units. [P, F, 3]
        distance: Median distance of the scene, scene units.

    Returns:
        Offset of each lamp from the lens, camera axes, scene units, and its share; shares sum to 1. [K, 4]
    """
    chosen = range(0, len(frames), max(1, len(frames) // _FRAMES))
    walls = [_Wall(frames[index], sights[:, index].float()) for index in chosen]
    residuals, usable = residuals[:, chosen], usable[:, chosen]

    def darkness(place: Float[Tensor, "3"]) -> Float[Tensor, "P F"]:
        return torch.stack([wall.darkness(place) for wall in walls], dim=1)

    places = [
        distance * radius * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        for radius, count in _RINGS
        for angle in (2 * math.pi * index / count for index in range(count))
    ]
    shadows = [darkness(place) for place in places]
    lit = usable & (torch.stack(shadows).amax(0) == 0)
    albedos = torch.where(lit, residuals, torch.nan).nanmedian(dim=1, keepdim=True).values
    counts = usable & ~lit & (lit.sum(1, keepdim=True) >= _FEWEST)
    if not counts.any():
        return torch.zeros(0, 4)
    missing = (1.0 - (residuals - albedos)[counts].exp()).clamp(-1.0, 1.0).double()

    def fit(lamps: Sequence[tuple[Tensor, Tensor]]) -> tuple[np.ndarray, float]:
        """Shares of lamps, given with their shadows, and the squared residuals."""
        shares, norm = nnls(torch.stack([shadow for _, shadow in lamps], dim=1).numpy(), missing.numpy())
        return shares, norm**2

    def error(lamp: tuple[Tensor, Tensor]) -> float:
        return fit([*lamps, lamp])[1]

    tried = [(place, shadow[counts].double()) for place, shadow in zip(places, shadows, strict=True)]
    lamps: list[tuple[Tensor, Tensor]] = []
    least = total = float(missing.square().sum())
    while len(lamps) < MOST_LAMPS:
        lamp, step = min(tried, key=error), _STEP
        while step > _LAST_STEP:
            moves = [(place, darkness(place)[counts].double()) for place in lamp[0] + step * distance * _MOVES]
            moved = min(moves, key=error)
            if error(moved) < error(lamp):
                lamp = moved
            else:
                step /= 2
        shares, new_least = fit([*lamps, lamp])
        if least - new_least < _EXPLAINED * total or shares[-1] < _LEAST:
            break
        least = new_least
        lamps.append(lamp)
    if not lamps:
        return torch.zeros(0, 4)
    shares, _ = fit(lamps)
    weights = torch.from_numpy(shares / shares.sum()).float()
    return torch.cat([torch.stack([place for place, _ in lamps]), weights[:, None]], dim=1)


class _Wall:
    """The surface that a frame's depth shows, in camera axes, and points on it."""

    def __init__(self, frame: Frame, points: Float[Tensor, "P 3"]) -> None:
        assert frame.depth is not None
        camera = frame.camera
        stride = max(1, round(math.sqrt(camera.width * camera.height / _PIXELS)))
        depth = torch.where(frame.valid, frame.depth, torch.nan).cpu()[stride // 2 :: stride, stride // 2 :: stride]
        rows, columns = depth.shape
        shifted = 0.5 - (stride // 2 + 0.5) / stride  # of the pixel centres that are left
        self.camera = replace(
            camera,
            fx=camera.fx / stride,
            fy=camera.fy / stride,
            cx=camera.cx / stride + shifted,
            cy=camera.cy / stride + shifted,
            width=columns,
            height=rows,
            camera_to_world=torch.eye(4),
        )
        self.has_depth = depth.isfinite() & (depth > 0)
        self.positions = self.camera.unproject(depth)[self.has_depth]
        pixels, _ = self.camera.project(points)
        limits = torch.tensor([columns - 1, rows - 1])
        self.column, self.row = pixels.nan_to_num(0.0).clamp(torch.zeros(2), limits).long().unbind(1)

    def darkness(self, lamp: Float[Tensor, "3"]) -> Float[Tensor, "P"]:
        """Share of a lamp's light that does not reach each of the points."""
        sizes = 0.7 * self.positions[:, 2] / self.camera.fx
        dark = torch.zeros(self.has_depth.shape)
        dark[self.has_depth] = 1.0 - lit_shares(self.positions, torch.ones_like(sizes), sizes, self.camera, lamp)
        return dark[self.row, self.column]
