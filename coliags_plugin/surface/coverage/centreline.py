"""Centreline of a lumen, followed from a camera inside it, cylinder coordinates about it, and the wall in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.ndimage import (
    distance_transform_edt,
    gaussian_filter,
    gaussian_filter1d,
    percentile_filter,
    uniform_filter1d,
)
from scipy.spatial import cKDTree

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh


class NoLumenError(InputError):
    """There is no lumen around the cameras, or no section of one was seen."""


#: Spacing of the centreline's points, mm.
STEP = 1.0
#: Steps of the search, mm, and how far it goes on without enough wall around it.
_STRIDE, _PATIENCE = 2.0, 24.0
#: Farthest end from the start, mm.
_LONGEST = 600.0
#: Rays of a ring, the share of them that must hit, and the largest radius of a lumen, mm.
_RING, _SHARE, _WIDEST = 72, 0.5, 60.0
#: Standard deviation of the final smoothing, mm.
_SMOOTHING = 8.0
#: Share of the way to a ring's middle, and to the direction of the last stride, that the search takes at once.
_TOWARDS_MIDDLE, _TOWARDS_STRIDE = 0.4, 0.25
#: Window over which the seen share of a ring is taken, mm, so that what lies behind a fold ends no section; and the
#: share that a ring of the section must have at its ends.
_WINDOW, _SEEN_SHARE = 10, 0.5

Array = Float64[np.ndarray, "..."]


@dataclass(frozen=True)
class Centreline:
    """A curve through the lumen with frames that do not turn about it."""

    points: Float[np.ndarray, "M 3"]  # world, mm, ``STEP`` apart
    # Columns: the direction of clock 0, that of clock 90 degrees, and the tangent
    frames: Float[np.ndarray, "M 3 3"]
    arc: Float[np.ndarray, "M"]  # place along the curve, mm; 0 where it passes the shallowest camera

    def unroll(
        self, points: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """Place along the curve (mm), clock angle (degrees, 0 to 360) and distance from it (mm) of each point.

        Points beyond an end are on the plane of that end or behind it: their place is extrapolated along the tangent.
        """
        _, nearest = cKDTree(self.points).query(points)
        offset = points - self.points[nearest]
        local = np.einsum("nc,nck->nk", offset, self.frames[nearest])
        half = 0.5 * STEP
        inner = (nearest > 0) & (nearest < len(self.points) - 1)
        ahead = np.where(inner, np.clip(local[:, 2], -half, half), local[:, 2])
        clock = np.degrees(np.arctan2(local[:, 1], local[:, 0])) % 360.0
        return self.arc[nearest] + ahead, clock, np.hypot(local[:, 0], local[:, 1])


def find_centreline(mesh: TriangleMesh, cameras_to_world: Sequence[Float[np.ndarray, "4 4"]]) -> Centreline:
    """Follow the lumen both ways from the middle of the camera's path, as far as there is wall around it.

    In strides of 2 mm, the curve is drawn to the middle of the ring of wall around it; it goes straight on where less
    than half of a ring is there, for at most 24 mm. Places increase in the mean viewing direction of the cameras.
    Clock 0 (12 o'clock) is the mean upward direction of the images, and the clock runs as a viewer sees it who looks
    in that direction. Holes of the wall do not matter; poses are OpenCV's, lengths mm.
    """
    poses = np.asarray(cameras_to_world, np.float64)
    centers = poses[:, :3, 3]
    axis = _unit(poses[:, :3, 2].mean(axis=0))
    start = centers[np.argmin(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))]
    start, direction = _settled(mesh, start, axis)
    ahead = _followed(mesh, start, direction)
    behind = _followed(mesh, start, -direction)
    if len(ahead) + len(behind) < 5:
        raise NoLumenError(
            "there is not enough wall around the cameras to find the lumen's centreline",
            "the surface of a tube, around the camera's path",
            "Check that the mesh is the wall that the camera filmed, in the world of its poses",
        )
    return _curve(np.concatenate([behind[::-1], start[None], ahead]), poses)


@dataclass(frozen=True)
class LumenSection:
    """The part of a lumen that a recording is about, along the centreline, mm; beyond it nothing counts as missed."""

    start: float
    end: float

    def holds(self, arc: Float[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
        """Mask of places that are inside. [N]"""
        return np.asarray((arc >= self.start) & (arc <= self.end))

    @property
    def length(self) -> float:
        """Length from end to end, mm."""
        return self.end - self.start


def find_section(
    arc: Float[np.ndarray, "F"], areas: Float[np.ndarray, "F"], seen: Bool[np.ndarray, "F"]
) -> LumenSection:
    """Section from the first to the last place with half of the wall seen, over windows of 10 mm; no shorter than one.

    ``arc`` is the place of each triangle along the centreline, mm; wall that is missing has to be among them.
    """
    first = float(np.floor(arc.min()))
    index = (arc - first).astype(int)
    whole = uniform_filter1d(np.bincount(index, areas).astype(float), _WINDOW, mode="constant")
    shown = uniform_filter1d(np.bincount(index, areas * seen).astype(float), _WINDOW, mode="constant")
    half = np.flatnonzero((shown >= _SEEN_SHARE * whole) & (whole > 0.0))
    if not len(half) or half[-1] - half[0] + 1 < _WINDOW:
        where = f"along {half[-1] - half[0] + 1} mm only" if len(half) else "nowhere along the lumen"
        raise NoLumenError(
            f"{where} was half of the wall seen",
            f"a recording that shows a section of a lumen, {_WINDOW} mm of it at least",
            "Check that the mesh is the wall that the camera filmed, in the world of its poses",
        )
    return LumenSection(first + float(half[0]), first + float(half[-1]) + 1.0)


def _settled(mesh: TriangleMesh, start: Array, axis: Array) -> tuple[Array, Array]:
    """A place in the middle of the lumen near a camera, and the lumen's direction there.

    The direction goes from the middle of the wall that lies 30 degrees behind to the middle of that 30 degrees ahead.
    """
    direction = axis
    for _ in range(4):
        _, hits = _ring(mesh, start, direction, tilts=(-30.0, 30.0))
        behind, ahead = hits.reshape(2, _RING, 3)
        both = np.isfinite(behind).all(axis=1) & np.isfinite(ahead).all(axis=1)
        if both.mean() >= _SHARE:
            direction = _unit(direction + 0.5 * _unit((ahead[both] - behind[both]).mean(axis=0)))
        share, middle = _middle(mesh, start, direction)
        if share >= _SHARE:
            start = start + _TOWARDS_MIDDLE * (middle - start)
    return start, direction


def _followed(mesh: TriangleMesh, start: Array, direction: Array) -> Array:
    """Points from a start, without it, as far as the wall reaches. [K, 3]"""
    points, last_good = [start], 0
    while len(points) * _STRIDE < _LONGEST:
        here = points[-1] + _STRIDE * direction
        share, middle = _middle(mesh, here, direction)
        if share >= _SHARE:
            here = here + _TOWARDS_MIDDLE * (middle - here)
            last_good = len(points)
        elif (len(points) - last_good) * _STRIDE > _PATIENCE:
            break
        # A wall ahead ends the lumen: the dome of a closed end.
        _, reach = mesh.rays.cast(here, direction[None])
        if reach[0] < _STRIDE:
            break
        stride = here - points[max(0, len(points) - 4)]
        direction = _unit((1.0 - _TOWARDS_STRIDE) * direction + _TOWARDS_STRIDE * _unit(stride))
        points.append(here)
    return np.asarray(points[1 : last_good + 1]).reshape(-1, 3)


def _middle(mesh: TriangleMesh, place: Array, direction: Array) -> tuple[float, Array]:
    """Share of a ring around a place that is wall, and the ring's middle; gaps are bridged."""
    radius, _ = _ring(mesh, place, direction)
    there = np.isfinite(radius)
    if not there.any():
        return 0.0, place
    angle = np.arange(_RING) * (2.0 * np.pi / _RING)
    filled = np.interp(angle, angle[there], radius[there], period=2.0 * np.pi)
    # Centroid of the polygon, from equal sectors.
    weight = filled**2
    across, other = _across(direction)
    offset = (2.0 / 3.0) * (weight * filled * np.cos(angle)).sum() * across
    offset = offset + (2.0 / 3.0) * (weight * filled * np.sin(angle)).sum() * other
    return float(there.mean()), place + offset / weight.sum()


def _ring(mesh: TriangleMesh, place: Array, direction: Array, tilts: tuple[float, ...] = (0.0,)) -> tuple[Array, Array]:
    """Distances to the wall and hits all round, at each tilt towards the direction; NaN where there is none."""
    across, other = _across(direction)
    angle = np.arange(_RING)[:, None] * (2.0 * np.pi / _RING)
    outward = np.cos(angle) * across + np.sin(angle) * other
    rays = np.concatenate([np.cos(np.radians(tilt)) * outward + np.sin(np.radians(tilt)) * direction for tilt in tilts])
    _, distance = mesh.rays.cast(place, rays)
    distance = np.where(distance <= _WIDEST, distance, np.nan).astype(np.float64)
    return distance, place + distance[:, None] * rays


def _across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete a direction to a right-handed frame."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    across = _unit(np.cross(helper, direction))
    return across, np.cross(direction, across)


def _curve(points: Array, poses: Array) -> Centreline:
    """Smooth, evenly spaced curve with frames, from points of the search."""
    smooth = gaussian_filter1d(points, _SMOOTHING / _STRIDE, axis=0, mode="nearest")
    # The filter pulls the ends inwards: keep the ends themselves.
    weight = np.minimum(np.arange(len(points)), np.arange(len(points))[::-1]) * _STRIDE / (2.0 * _SMOOTHING)
    smooth += (points - smooth) * np.clip(1.0 - weight, 0.0, 1.0)[:, None]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    arc = np.arange(0.0, lengths[-1], STEP)
    line = np.stack([np.interp(arc, lengths, smooth[:, axis]) for axis in range(3)], axis=1)
    tangents = np.gradient(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    places = cKDTree(line).query(poses[:, :3, 3])[1]
    middle = int(np.median(places))
    frames = _frames(tangents, middle, -poses[:, :3, 1].mean(axis=0))
    along, _, _ = Centreline(line, frames, arc).unroll(poses[:, :3, 3])
    return Centreline(line, frames, arc - along.min())


def _frames(tangents: Array, start: int, up: Array) -> Array:
    """Frames carried along the curve without turning, from ``up`` at a start. [M, 3, 3]"""
    frames = np.empty((len(tangents), 3, 3))
    for order in (range(start, len(tangents)), range(start, -1, -1)):
        across = up
        for index in order:
            across = across - (across @ tangents[index]) * tangents[index]
            across = _unit(across) if np.linalg.norm(across) > 1e-9 else _across(tangents[index])[0]
            # Looking along the tangent with clock 0 up, clock 90 degrees is to the right.
            frames[index] = np.stack([across, np.cross(tangents[index], across), tangents[index]], axis=-1)
    return frames


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


#: Clock angles of the grid.
CLOCKS = 180
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
        """Mask of cells with wall. [M, C]"""
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
    """Unit directions across a centreline, from each of its points at each clock angle. [M, C, 3]"""
    angle = np.radians(np.arange(CLOCKS) * (360.0 / CLOCKS))[:, None]
    return np.asarray(np.cos(angle) * line.frames[:, None, :, 0] + np.sin(angle) * line.frames[:, None, :, 1])
