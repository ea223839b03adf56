"""The wall as a radius over place along the lumen and clock angle, and a guess of it where it was not reconstructed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter, percentile_filter

from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.coverage.centreline import STEP, Centreline

#: Clock angles of the grid.
CLOCKS = 180
#: Farthest wall from the centreline, mm.
_WIDEST = 60.0
#: Length and angle over which the lumen's calibre is taken, mm and degrees, and its percentile of the radius there:
#: the wall between folds, not their tips.
_CALIBRE_LENGTH, _CALIBRE_ANGLE, _CALIBRE = 30.0, 60.0, 70
#: Distance from reconstructed wall over which a guess goes from its radius to the calibre, mm.
_BLEND = 3.0


@dataclass(frozen=True, eq=False)
class TubeGrid:
    """First wall around a centreline: rays outwards from each of its points, M places by C clock angles."""

    line: Centreline
    radius: Float[np.ndarray, "M C"]  # distance of the wall from it, mm; NaN where there is none
    triangle: Int[np.ndarray, "M C"]  # the triangle hit; -1 where there is none

    @property
    def there(self) -> Bool[np.ndarray, "M C"]:
        """Where there is wall. [M, C]"""
        return np.asarray(self.triangle >= 0)


def wall_around(mesh: TriangleMesh, line: Centreline) -> TubeGrid:
    """Cast rays outwards from a centreline."""
    origins = np.repeat(line.points, CLOCKS, axis=0)
    directions = _outward(line).reshape(-1, 3)
    triangle, distance = mesh.rays.cast(origins, directions)
    hit = (triangle >= 0) & (distance <= _WIDEST)
    shape = (len(line.points), CLOCKS)
    radius = np.where(hit, distance, np.nan).astype(np.float64)
    return TubeGrid(line, radius.reshape(shape), np.where(hit, triangle, -1).reshape(shape))


def guessed_wall(grid: TubeGrid) -> TriangleMesh:
    """A guess of the wall where the grid of a reconstruction has none; without triangles where there is no gap.

    Next to reconstructed wall the guess has its radius; within about 3 mm it goes over to the calibre of the lumen
    around there, a high percentile of the radius of the wall within 15 mm along and 30 degrees around. So a fold that
    hides what is behind it is not prolonged into a funnel. Triangles are counter-clockwise seen from the lumen, one
    cell of the grid apart from the reconstructed wall at most.
    """
    there = grid.there
    if there.all() or not there.any():
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    radius, line = _filled(grid), grid.line
    vertices = line.points[:, None] + radius[..., None] * _outward(line)
    # Cells with a corner in a gap; the others are reconstructed.
    gap = ~there
    following = np.roll(gap, -1, axis=1)
    row, column = np.nonzero(gap[:-1] | following[:-1] | gap[1:] | following[1:])
    beside = (column + 1) % CLOCKS
    a, b = row * CLOCKS + column, (row + 1) * CLOCKS + column
    c, d = row * CLOCKS + beside, (row + 1) * CLOCKS + beside
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([d, c, b], axis=1)])
    whole = TriangleMesh(vertices.reshape(-1, 3), triangles)
    return whole.part(np.ones(len(triangles), bool))


def _filled(grid: TubeGrid) -> Float64[np.ndarray, "M C"]:
    """Radius everywhere: that of the wall, and a guess in its gaps. [M, C]"""
    there, radius = grid.there, grid.radius
    middle = float(np.nanmedian(radius))
    # Millimetres across a cell: along the line, and around at the median radius.
    spacing = (STEP, 2.0 * np.pi * middle / CLOCKS)
    wide = CLOCKS // 3
    gap, at = np.pad(~there, ((0, 0), (wide, wide)), mode="wrap"), np.pad(radius, ((0, 0), (wide, wide)), mode="wrap")
    away, (row, column) = distance_transform_edt(gap, sampling=spacing, return_indices=True)
    nearest = at[row, column]
    reach = (int(_CALIBRE_LENGTH / STEP), int(_CALIBRE_ANGLE / 360.0 * CLOCKS))
    calibre = percentile_filter(nearest, _CALIBRE, size=reach, mode="nearest")
    calibre = np.maximum(gaussian_filter(calibre, 4.0, mode="nearest"), 1.0)
    guess = calibre + (nearest - calibre) * np.exp(-((away / _BLEND) ** 2))
    return np.asarray(np.where(gap, guess, at)[:, wide : wide + CLOCKS])


def _outward(line: Centreline) -> Float64[np.ndarray, "M C 3"]:
    """Directions from each point of a centreline at each clock angle. [M, C, 3]"""
    clock = np.arange(CLOCKS) * (360.0 / CLOCKS)
    return np.stack([line.directions(index, clock) for index in range(len(line.points))])
