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

    The map has the camera's image seen from the lamp. A place covers the cells, a pixel wide, whose centres are within
    its size along both axes, and the cell that it is in. The surface of a cell is the mean depth, weighted by opacity,
    of the places within :data:`LAYER` of the nearest; a place is lit where it is not behind the surfaces of the four
    cells around it, interpolated bilinearly. Where the map knows of no surface, everything is lit.

    Args:
        positions: World frame, scene units. [N, 3]
        opacities: In [0, 1]; of :data:`OPAQUE` or less casts no shadow. [N]
        sizes: Half widths, scene units. [N]
        camera: The camera.
        lamp: Position of the lamp, camera axes, scene units. [3]
    """
    rotation = camera.camera_to_world[:3, :3].to(positions)
    seen = (positions - camera.center.to(positions)) @ rotation - lamp.to(positions)
    if fit_kernels(positions):
        from coliags_plugin.core.numba_kernels.shadows import draw_and_compare
        from coliags_plugin.core.numba_kernels.threads import Crew

        view = np.array([camera.fx, camera.fy, camera.cx, camera.cy, OPAQUE, LAYER, *SHADOW, REACH], np.float32)
        shares = torch.empty(len(positions))
        nearest = np.empty((camera.height + 2 * BORDER, camera.width + 2 * BORDER), np.float32)
        Crew().run(draw_and_compare, *tables(seen, opacities, sizes), view, BORDER, nearest, *tables(shares))
        return shares
    return _lit_shares(seen, opacities, sizes, camera)


def _lit_shares(
    seen: Float[Tensor, "N 3"], opacities: Float[Tensor, "N"], sizes: Float[Tensor, "N"], camera: Camera
) -> Float[Tensor, "N"]:
    """The same in PyTorch, of places in the axes of a camera at the lamp."""
    rows, columns = camera.height + 2 * BORDER, camera.width + 2 * BORDER
    depth = seen[:, 2]
    ahead = depth > 0
    safe = torch.where(ahead, depth, 1.0)
    column = camera.fx * seen[:, 0] / safe + (camera.cx + BORDER - 0.5)
    row = camera.fy * seen[:, 1] / safe + (camera.cy + BORDER - 0.5)
    # Cells of every footprint, one after the other: from the first row and column, so many of each.
    reach = (camera.fx * sizes / safe).clamp_max(REACH)
    ranges = []
    for centre, cells in ((row, rows), (column, columns)):
        first, last = (centre - reach).ceil(), (centre + reach).floor()
        its_own = centre.round()
        first, last = (torch.where(last < first, its_own, end) for end in (first, last))
        ranges.append((first.clamp_min(0), last.clamp_max(cells - 1)))
    (top, bottom), (left, right) = ranges
    casts = ahead & (opacities > OPAQUE) & (bottom >= top) & (right >= left)
    casters = casts.nonzero().squeeze(1)
    wide = (right - left + 1)[casters].long()
    counts = (bottom - top + 1)[casters].long() * wide
    drawn = torch.arange(len(casters), device=seen.device).repeat_interleave(counts)
    place = torch.arange(len(drawn), device=seen.device) - (counts.cumsum(0) - counts)[drawn]
    each = casters[drawn]
    cell = (top[each].long() + place // wide[drawn]) * columns + left[each].long() + place % wide[drawn]
    nearest = torch.full((rows * columns,), torch.inf).to(seen).scatter_reduce(0, cell, depth[each], "amin")
    weights = torch.where(depth[each] < LAYER * nearest[cell], opacities[each], 0.0)
    total = torch.zeros_like(nearest).index_add_(0, cell, weights)
    weighted = torch.zeros_like(nearest).index_add_(0, cell, weights * depth[each])
    surface = torch.where(total > 0, weighted / total, torch.inf)
    # Bilinear comparison.
    first_row, first_column = row.floor(), column.floor()
    inside = ahead & (first_row >= 0) & (first_column >= 0) & (first_row < rows - 1) & (first_column < columns - 1)
    start = torch.where(inside, first_row * columns + first_column, 0.0).long()
    down, across = row - first_row, column - first_column
    lit = torch.zeros_like(depth)
    for offset, share in (
        (0, (1 - down) * (1 - across)),
        (1, (1 - down) * across),
        (columns, down * (1 - across)),
        (columns + 1, down * across),
    ):
        behind = depth / surface[start + offset] - 1.0
        lit += share * ((SHADOW[1] - behind) / (SHADOW[1] - SHADOW[0])).clamp(0.0, 1.0)
    return torch.where(inside, lit, 1.0)


#: Distances from the lens, as shares of the scene's, and numbers of the lamps that are tried first; the step in which
#: they are then moved, and that to which it is halved.
_RINGS, _STEP, _LAST_STEP = ((0.05, 6), (0.09, 9), (0.13, 12)), 0.03, 0.006
_MOVES = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
#: Most lamps, and the least share of the squared residuals that each must explain.
MOST_LAMPS, _EXPLAINED = 3, 0.05
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

    def darkness(lamp: Float[Tensor, "3"]) -> Float[Tensor, "P F"]:
        return torch.stack([wall.darkness(lamp) for wall in walls], dim=1)

    tried = [
        distance * radius * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        for radius, count in _RINGS
        for angle in (2 * math.pi * index / count for index in range(count))
    ]
    shadows = [darkness(lamp) for lamp in tried]
    lit = usable & (torch.stack(shadows).amax(0) == 0)
    albedos = torch.where(lit, residuals, torch.nan).nanmedian(dim=1, keepdim=True).values
    counts = usable & ~lit & (lit.sum(1, keepdim=True) >= _FEWEST)
    if not counts.any():
        return torch.zeros(0, 4)
    missing = (1.0 - (residuals - albedos)[counts].exp()).clamp(-1.0, 1.0).double().numpy()

    def fitted(shadows: Sequence[Tensor]) -> tuple[np.ndarray, float]:
        shares, norm = nnls(torch.stack([shadow[counts] for shadow in shadows], dim=1).double().numpy(), missing)
        return shares, norm**2

    total = float(np.square(missing).sum())
    lamps: list[Tensor] = []
    cast: list[Tensor] = []
    shares, error = np.zeros(0), total
    while len(lamps) < MOST_LAMPS:
        best = min(range(len(tried)), key=lambda index: fitted([*cast, shadows[index]])[1])
        lamp, shadow, step = tried[best], shadows[best], _STEP
        new_shares, new_error = fitted([*cast, shadow])
        while step > _LAST_STEP:
            moves = [lamp + step * distance * move for move in _MOVES]
            trials = [(*fitted([*cast, moved]), moved, place) for place in moves for moved in [darkness(place)]]
            trial = min(trials, key=lambda each: each[1])
            if trial[1] < new_error:
                new_shares, new_error, shadow, lamp = trial
            else:
                step /= 2
        if error - new_error < _EXPLAINED * total:
            break
        lamps, cast, shares, error = [*lamps, lamp], [*cast, shadow], new_shares, new_error
    if not lamps:
        return torch.zeros(0, 4)
    weights = torch.from_numpy(shares / shares.sum()).float()
    return torch.cat([torch.stack(lamps), weights[:, None]], dim=1)


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
