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
    """First wall around a centreline: rays outwards from each of its points, M places by C clock angles.

    Attributes:
        line: The centreline.
        radius: Distance of the wall from it, mm; NaN where there is none. [M, C]
        triangle: The triangle hit; -1 where there is none. [M, C]
    """

    line: Centreline
    radius: Float[np.ndarray, "M C"]
    triangle: Int[np.ndarray, "M C"]

    @property
    def clock(self) -> Float[np.ndarray, "C"]:
        """Clock angles, degrees. [C]"""
        return _clocks()

    @property
    def there(self) -> Bool[np.ndarray, "M C"]:
        """Where there is wall. [M, C]"""
        return np.asarray(self.triangle >= 0)


def wall_around(mesh: TriangleMesh, line: Centreline) -> TubeGrid:
    """Cast rays outwards from a centreline."""
    origins = np.repeat(line.points, CLOCKS, axis=0)
    directions = np.concatenate([line.directions(index, _clocks()) for index in range(len(line.points))])
    triangle, distance = mesh.rays.cast(origins, directions)
    hit = (triangle >= 0) & (distance <= _WIDEST)
    shape = (len(line.points), CLOCKS)
    radius = np.where(hit, distance, np.nan).astype(np.float64)
    return TubeGrid(line, radius.reshape(shape), np.where(hit, triangle, -1).reshape(shape))


def guessed_wall(grid: TubeGrid) -> TriangleMesh:
    """A guess of the wall where a grid has none, as a mesh.

    Next to reconstructed wall the guess has its radius; within about 3 mm it goes over to the calibre of the lumen
    around there, a high percentile of the radius of the wall within 15 mm along and 30 degrees around. So a fold that
    hides what is behind it is not prolonged into a funnel.

    Args:
        grid: Of the reconstructed wall.

    Returns:
        Triangles counter-clockwise seen from the lumen, one cell of the grid apart from the reconstructed wall at most;
        without triangles where the grid has no gap.
    """
    there = grid.there
    if there.all() or not there.any():
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    radius = _filled(grid)
    line = grid.line
    outward = np.stack([line.directions(index, grid.clock) for index in range(len(line.points))])
    vertices = line.points[:, None] + radius[..., None] * outward
    # Cells with a corner in a gap; the others are reconstructed.
    gap = ~there
    following = np.roll(gap, -1, axis=1)
    cells = gap[:-1] | following[:-1] | gap[1:] | following[1:]
    row, column = np.nonzero(cells)
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


def _clocks() -> Float64[np.ndarray, "C"]:
    return np.arange(CLOCKS) * (360.0 / CLOCKS)
