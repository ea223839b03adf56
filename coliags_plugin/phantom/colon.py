"""Geometry of the colon's wall: its radius over arc length and clock angle, its mesh, and rays cast at meshes.

The wall lies at ``centre(s) + radius(s, phi) (cos phi n + sin phi b)``. Sizes follow docs/phantom.md 1: radius
20 mm, three taeniae that make the lumen three-lobed, and between them haustral folds - thin crescents 5 to 8 mm high
about every 25 mm. Lengths are mm, angles radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, SolidNoise, smoothstep, stream

#: Length of the segment, mm.
LENGTH = 232.0
#: Arc length at which the strong bend begins and over which it turns, mm. Its tightest radius of curvature, about
#: 26 mm, stays above the lumen's radius, so the wall never folds into itself.
BEND_START, BEND_LENGTH = 112.0, 82.0
BEND_ANGLE = 1.65
_STEP = 0.25
RADIUS = 20.0
#: Length over which the far end rounds off into a closed dome.
DOME = 18.0
_TAENIAE = 2.0 * np.pi / 3.0 * np.arange(3)
#: Size and standard deviation of the wall's unevenness, mm.
_RELIEF = ((4.0, 0.2), (1.5, 0.05), (0.6, 0.015))


@dataclass(frozen=True)
class CentreLine:
    """A space curve with a rotation-minimising frame."""

    points: Float[np.ndarray, "M 3"]  # world, mm, every 0.25 mm of arc
    frames: Float[np.ndarray, "M 3 3"]  # columns: across, across and tangent; right-handed

    def at(self, arc: Float[np.ndarray, "N"]) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 3"]]:
        """Points and frames at arc lengths, mm."""
        position = np.clip(np.asarray(arc, dtype=np.float64) / _STEP, 0.0, len(self.points) - 1.001)
        low = position.astype(int)
        weight = position - low
        points = self.points[low] * (1.0 - weight)[:, None] + self.points[low + 1] * weight[:, None]
        mixed = self.frames[low] * (1.0 - weight)[:, None, None] + self.frames[low + 1] * weight[:, None, None]
        tangent = mixed[..., 2] / np.linalg.norm(mixed[..., 2], axis=-1, keepdims=True)
        across = mixed[..., 0] - (mixed[..., 0] * tangent).sum(-1, keepdims=True) * tangent
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        return points, np.stack([across, np.cross(tangent, across), tangent], axis=-1)


def grow_centre_line(generator: np.random.Generator) -> CentreLine:
    """Generate a gentle curve with a strong bend at its end, which closes the lumen in the image.

    Starts at the origin, roughly along +z.
    """
    arc = np.arange(0.0, LENGTH + _STEP, _STEP)
    bend = smoothstep((arc - BEND_START) / BEND_LENGTH)
    clock = generator.uniform(0.0, 2.0 * np.pi)
    angles = []
    for direction in (np.cos(clock), np.sin(clock)):
        phase, period, amplitude = generator.uniform([0.0, 150.0, 0.14], [2.0 * np.pi, 210.0, 0.24])
        gentle = amplitude * (np.sin(2.0 * np.pi * arc / period + phase) - np.sin(phase))
        angles.append(gentle * (1.0 - bend) + direction * BEND_ANGLE * bend)
    yaw, pitch = angles
    tangents = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=-1)
    middle = 0.5 * (tangents[1:] + tangents[:-1])
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(middle * _STEP, axis=0)])
    frames = np.empty((len(arc), 3, 3))
    across = np.array([1.0, 0.0, 0.0])
    for index, tangent in enumerate(tangents):
        # Parallel transport: drop what is no longer perpendicular. The frame never spins about the curve.
        across = across - (across @ tangent) * tangent
        across = across / np.linalg.norm(across)
        frames[index] = np.stack([across, np.cross(tangent, across), tangent], axis=-1)
    return CentreLine(points, frames)


@dataclass(frozen=True)
class Fold:
    """A haustral fold: a thin crescent across part of the circumference; mm and radians."""

    arc: float  # arc length of its position
    clock: float  # middle of the crescent
    half_width: float  # half the angle it spans
    height: float  # above the wall at its middle
    thickness: float  # full width at half height
    slant: float  # distance of its ends ahead of its middle
    sway: tuple[float, float]  # amplitude and phase of its waviness

    def rise(self, arc: Float[np.ndarray, "S 1"], clock: Float[np.ndarray, "1 C"]) -> Float[np.ndarray, "S C"]:
        """Height above the wall, mm."""
        turn = _wrapped(clock - self.clock)
        across = np.clip(1.0 - (turn / self.half_width) ** 2, 0.0, None)
        ridge = self.arc + self.slant * (turn / self.half_width) ** 2 + self.sway[0] * np.sin(3.0 * turn + self.sway[1])
        along = np.abs(arc - ridge)
        crest = np.exp(-np.log(2.0) * (2.0 * along / self.thickness) ** 2.4)
        foot = np.exp(-((along / 6.0) ** 2))
        return np.asarray(self.height * across**1.3 * (0.82 * crest + 0.18 * foot))


@dataclass(frozen=True)
class Polyp:
    """A sessile polyp: a cap ``width`` mm wide and ``height`` mm high."""

    arc: float
    clock: float
    width: float
    height: float

    def nearness(self, arc: Float[np.ndarray, "S 1"], clock: Float[np.ndarray, "1 C"]) -> Float[np.ndarray, "S C"]:
        """1 at the middle, 0 at the rim and outside."""
        along = arc - self.arc
        across = _wrapped(clock - self.clock) * RADIUS
        return np.asarray(np.clip(1.0 - (along**2 + across**2) / (0.5 * self.width) ** 2, 0.0, None))


@dataclass(frozen=True)
class Anatomy:
    """Parameters of the wall's large-scale shape."""

    centre_line: CentreLine
    folds: tuple[Fold, ...]
    polyps: tuple[Polyp, ...]
    taenia_clock: float
    taenia_twist: float
    swell_phase: float

    def radius(self, arc: Float[np.ndarray, "S"], clock: Float[np.ndarray, "C"]) -> Float[np.ndarray, "S C"]:
        """Distance of the wall from the centre line, mm."""
        arc, clock = arc[:, None], clock[None, :]
        # Narrower beyond the bend (and so never wider than the bend's radius of curvature).
        calibre = RADIUS * (1.0 + 0.05 * np.sin(2.0 * np.pi * arc / 90.0 + self.swell_phase))
        calibre *= 1.0 - 0.15 * smoothstep((arc - 110.0) / 50.0)
        twisted = clock - self.taenia_clock - self.taenia_twist * arc
        bands = np.exp(-0.5 * (_wrapped(twisted[None] - _TAENIAE[:, None, None]) / 0.2) ** 2).sum(axis=0)
        lobes = np.cos(3.0 * twisted)
        wall = calibre * (1.0 - 0.055 * lobes - 0.04 * bands)
        # A fourth-power sum keeps crossing crescents from piling up, and is smooth.
        rise = np.zeros_like(wall)
        for fold in self.folds:
            rows = slice(*np.searchsorted(arc[:, 0], [fold.arc - 22.0, fold.arc + 22.0]))
            rise[rows] += fold.rise(arc[rows], clock) ** 4
        wall -= rise**0.25
        for polyp in self.polyps:
            rows = slice(*np.searchsorted(arc[:, 0], [polyp.arc - polyp.width, polyp.arc + polyp.width]))
            wall[rows] -= polyp.height * polyp.nearness(arc[rows], clock) ** 0.75
        into_dome = np.clip((arc - (LENGTH - DOME)) / DOME, 0.0, 1.0)
        return np.asarray(np.clip(wall, 4.0, None) * np.sqrt(np.clip(1.0 - into_dome**2, 0.0, None)))


def grow_anatomy(settings: PhantomSettings) -> Anatomy:
    """Sample a random colon."""
    generator = stream(settings.seed, Purpose.ANATOMY)
    centre_line = grow_centre_line(generator)
    taenia_clock = generator.uniform(0.0, 2.0 * np.pi)
    twist = generator.uniform(-0.003, 0.003)
    swell = generator.uniform(0.0, 2.0 * np.pi)
    folds: list[Fold] = []
    stations: list[float] = []
    station = generator.uniform(6.0, 14.0)
    while station < LENGTH - DOME - 4.0:
        stations.append(station)
        # Two or three of the sectors between taeniae carry a crescent; together they shape the opening.
        sectors = generator.permutation(3)[: generator.choice([2, 3])]
        tallest = generator.uniform(5.0, 8.0)
        for rank, sector in enumerate(sectors):
            middle = taenia_clock + twist * station + _TAENIAE[sector] + np.pi / 3.0
            folds.append(
                Fold(
                    arc=station + generator.uniform(-2.5, 2.5),
                    clock=float(middle + generator.normal(0.0, 0.12)),
                    half_width=generator.uniform(np.pi / 3.0, 2.0 * np.pi / 3.0),
                    height=tallest if rank == 0 else generator.uniform(5.0, max(tallest, 5.01)),
                    thickness=generator.uniform(2.2, 4.0),
                    slant=generator.uniform(-3.0, 3.0),
                    sway=(generator.uniform(0.2, 0.8), generator.uniform(0.0, 2.0 * np.pi)),
                )
            )
        station += generator.normal(settings.fold_spacing, 0.12 * settings.fold_spacing)
    # Between two folds, on the part of the wall that the camera looks at.
    between = [0.5 * (a + b) for a, b in pairwise(stations)]
    places = [arc for arc in between if 30.0 < arc < 125.0]
    polyps = []
    for _ in range(settings.polyps):
        arc = float(generator.choice(places)) + generator.uniform(-4.0, 4.0)
        width = generator.uniform(3.0, 10.0)
        polyps.append(Polyp(arc, generator.uniform(0.0, 2.0 * np.pi), width, width * generator.uniform(0.33, 0.39)))
    return Anatomy(centre_line, tuple(folds), tuple(polyps), taenia_clock, twist, swell)


@dataclass(frozen=True)
class ColonSurface:
    """The wall as a mesh on a grid: rows along the colon, columns around it (periodic).

    Rows are evenly spaced along the wall's surface, not along the centre line, so that texture and mesh are not
    stretched on the flanks of folds. Vertices are row-major.
    """

    vertices: Float[np.ndarray, "V 3"]  # world, mm
    normals: Float[np.ndarray, "V 3"]  # unit, into the lumen
    tangents: Float[np.ndarray, "V 3"]  # unit, along the colon
    triangles: Int[np.ndarray, "F 3"]  # vertex indices; counter-clockwise seen from the lumen
    areas: Float[np.ndarray, "V"]  # wall area of each vertex, mm^2
    arc: Float[np.ndarray, "R"]  # arc length of each row, mm
    columns: int
    row_length: float  # mean distance of rows along the wall, mm

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.arc)

    @cached_property
    def tracer(self) -> Tracer:
        """Casts rays at the wall; made once."""
        return Tracer(self.vertices, self.triangles)

    def grid_coordinates(
        self, triangle: Int[np.ndarray, "N"], barycentric: Float[np.ndarray, "N 2"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """Fractional row and column of points inside triangles, by the weights of the second and third corner."""
        cell, odd = np.divmod(triangle, 2)
        row, column = np.divmod(cell, self.columns)
        sign = 1.0 - 2.0 * odd.astype(np.float32)
        start = odd.astype(np.float32)
        return (
            row.astype(np.float32) + start + sign * barycentric[:, 0],
            column.astype(np.float32) + start + sign * barycentric[:, 1],
        )


def build_surface(anatomy: Anatomy, settings: PhantomSettings) -> ColonSurface:
    """Mesh the wall, with fine displacement noise, at ``settings.mesh_spacing``."""
    # Rows that are evenly spaced along the wall.
    fine = np.linspace(0.0, LENGTH, 4 * round(LENGTH) + 1)
    step = fine[1] - fine[0]
    slope = np.diff(anatomy.radius(fine, np.arange(96) * (2.0 * np.pi / 96)), axis=0) / step
    walked = np.concatenate([[0.0], np.cumsum(np.sqrt(1.0 + (slope**2).mean(axis=1)) * step)])
    rows = max(round(walked[-1] / settings.mesh_spacing), 24) + 1
    arc = np.interp(np.linspace(0.0, walked[-1], rows), walked, fine)
    columns = max(round(2.0 * np.pi * 0.95 * RADIUS / settings.mesh_spacing), 24)
    clock = np.arange(columns) * (2.0 * np.pi / columns)
    row_length = float(walked[-1]) / (len(arc) - 1)
    radius = anatomy.radius(arc, clock)
    centres, frames = anatomy.centre_line.at(arc)
    around = np.cos(clock)[None, :, None] * frames[:, None, :, 0] + np.sin(clock)[None, :, None] * frames[:, None, :, 1]
    noise = SolidNoise(stream(settings.seed, Purpose.RELIEF))
    smooth = (centres[:, None, :] + radius[:, :, None] * around).astype(np.float32)
    for scale, height in _RELIEF:
        bumps = noise.layer(smooth, scale)
        # A layer finer than the mesh would be aliased.
        if scale > settings.mesh_spacing:
            radius -= height * np.clip(radius / RADIUS, 0.0, 1.0) * bumps
    grid = centres[:, None, :] + radius[:, :, None] * around
    return surface_of(grid, frames, arc, row_length)


def surface_of(
    grid: Float[np.ndarray, "R C 3"], frames: Float[np.ndarray, "R 3 3"], arc: Float[np.ndarray, "R"], row_length: float
) -> ColonSurface:
    """The mesh of a grid of points; ``frames`` are the centre line's axes at its rows."""
    along = np.gradient(grid, axis=0)
    across = 0.5 * (np.roll(grid, -1, axis=1) - np.roll(grid, 1, axis=1))
    normals = np.cross(along, across)
    areas = np.linalg.norm(normals, axis=-1)
    # At the tip of the dome all vertices of a row coincide; their normal points back along the colon.
    tip = areas < 1e-9
    normals[tip] = np.broadcast_to(-frames[:, None, :, 2], grid.shape)[tip]
    along[tip] = np.broadcast_to(frames[:, None, :, 0], grid.shape)[tip]
    return ColonSurface(
        vertices=grid.reshape(-1, 3).astype(np.float32),
        normals=unit(normals).reshape(-1, 3).astype(np.float32),
        tangents=unit(along).reshape(-1, 3).astype(np.float32),
        triangles=grid_triangles(*grid.shape[:2]),
        areas=areas.reshape(-1).astype(np.float32),
        arc=arc,
        columns=grid.shape[1],
        row_length=row_length,
    )


def grid_triangles(rows: int, columns: int, corners: str = "abc dcb", wraps: bool = True) -> Int[np.ndarray, "F 3"]:
    """Two triangles for each cell of a grid of vertices, whose columns may close upon themselves.

    ``corners`` are theirs: a and c of one row, and b and d of the next.
    """
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns if wraps else columns - 1), indexing="ij")
    following = (column + 1) % columns
    index = {"a": row * columns + column, "b": (row + 1) * columns + column}
    index |= {"c": row * columns + following, "d": (row + 1) * columns + following}
    triangles = [np.stack([index[corner] for corner in triangle], axis=-1) for triangle in corners.split()]
    return np.stack(triangles, axis=2).reshape(-1, 3).astype(np.uint32)


def around_the_colon(
    grid: Float[np.ndarray, "R C 3"], row: Float[np.ndarray, "N"], column: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N 3"]:
    """Bilinear values of a grid with periodic columns at fractional rows and columns, in the grid's precision."""
    columns = grid.shape[1]
    top, left = row.astype(np.int64), np.floor(column).astype(np.int64)
    down, right = (row - top).astype(grid.dtype)[:, None], (column - left).astype(grid.dtype)[:, None]
    flat, a, b = grid.reshape(-1, 3), top * columns + left % columns, top * columns + (left + 1) % columns
    above = flat[a] * (1.0 - right) + flat[b] * right
    below = flat[a + columns] * (1.0 - right) + flat[b + columns] * right
    return np.asarray(above * (1.0 - down) + below * down)


def unit(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Vectors of length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _wrapped(angle: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Angle wrapped to [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


#: Length of the bend by breathing along the colon, mm: one period; and the time of one breath, s.
_BEND, BREATH = 160.0, 4.0
#: Length of the peristaltic wave along the centre line, mm, and its speed towards the shallow end, mm/s.
WAVE_LENGTH, WAVE_SPEED = 60.0, 10.0


@dataclass(frozen=True)
class WallMotion:
    """Displacement of the wall from rest. float32, as it is written, so that the files give the same vertices."""

    rest: ColonSurface
    frames: Float[np.ndarray, "R 3 3"]  # axes of the centre line at each row
    radial: Float[np.ndarray, "R C 3"]  # unit, away from the centre line
    wave: Float[np.ndarray, "T R"]  # along radial, mm
    shift: Float[np.ndarray, "T R 3"]  # world, mm

    def at(self, frame: int) -> ColonSurface:
        """The wall at a frame."""
        moved = self.wave[frame, :, None, None] * self.radial + self.shift[frame, :, None]
        grid = self.rest.vertices.reshape(self.radial.shape) + moved
        return surface_of(grid.astype(np.float64), self.frames, self.rest.arc, self.rest.row_length)


def frame_times(settings: PhantomSettings) -> Float[np.ndarray, "T"]:
    """Time of every frame, s."""
    return np.arange(settings.frames) / settings.frame_rate


def wall_motion(anatomy: Anatomy, surface: ColonSurface, settings: PhantomSettings) -> WallMotion | None:
    """The wall's motion; None if it is rigid."""
    if not settings.moves:
        return None
    times = frame_times(settings)
    _, frames = anatomy.centre_line.at(surface.arc)
    clock = np.arange(surface.columns)[None, :, None] * (2.0 * np.pi / surface.columns)
    radial = np.cos(clock) * frames[:, None, :, 0] + np.sin(clock) * frames[:, None, :, 1]
    generator = stream(settings.seed, Purpose.WALL_MOTION)
    phases = generator.uniform(0.0, 2.0 * np.pi, 4)
    return WallMotion(
        rest=surface,
        frames=frames,
        radial=radial.astype(np.float32),
        wave=peristalsis(surface.arc, times, settings, phases[0]).astype(np.float32),
        shift=breathing(surface.arc, times, settings, frames[len(frames) // 2], phases[1:]).astype(np.float32),
    )


def peristalsis(
    arc: Float[np.ndarray, "R"], times: Float[np.ndarray, "T"], settings: PhantomSettings, phase: float
) -> Float[np.ndarray, "T R"]:
    """Change of the radius, mm: a sine that travels towards the shallow end and fades out towards the closed end."""
    travelled = arc[None] + WAVE_SPEED * times[:, None]
    fade = smoothstep((LENGTH - DOME - arc) / 20.0)
    return np.asarray(settings.wave * fade * np.sin(2.0 * np.pi * travelled / WAVE_LENGTH + phase))


def breathing(
    arc: Float[np.ndarray, "R"],
    times: Float[np.ndarray, "T"],
    settings: PhantomSettings,
    axes: Float[np.ndarray, "3 3"],
    phases: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "T R 3"]:
    """Displacement of the centre line, world, mm: it bends and straightens across a fixed direction."""
    direction = np.cos(phases[0]) * axes[:, 0] + np.sin(phases[0]) * axes[:, 1]
    along = np.sin(2.0 * np.pi * arc / _BEND + phases[1])
    swing = settings.breathing * np.sin(2.0 * np.pi * times / BREATH + phases[2])
    return np.asarray(swing[:, None, None] * along[None, :, None] * direction)


@dataclass(frozen=True)
class Hits:
    """First hits of N rays on the wall."""

    found: Bool[np.ndarray, "N"]
    z_depth: Float[np.ndarray, "N"]  # mm; infinite without a hit
    triangle: Int[np.ndarray, "N"]  # index
    barycentric: Float[np.ndarray, "N 2"]  # weights of the second and third corner

    def only(self, keep: Bool[np.ndarray, "N"]) -> Hits:
        """Hits of some of the rays."""
        return Hits(self.found[keep], self.z_depth[keep], self.triangle[keep], self.barycentric[keep])


def rotated(vectors: Float[np.ndarray, "N 3"], rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "N 3"]:
    """``rotation @ vector`` for many vectors, in their precision; several times faster than a matrix product."""
    return np.einsum("nc,dc->nd", vectors, rotation.astype(vectors.dtype))


class Tracer:
    """Ray-casting scene of a mesh: the wall, or a body over it."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> None:
        self._triangles = triangles
        self._rays = TriangleMesh(vertices, triangles).rays

    def cast(self, camera_to_world: Float[np.ndarray, "4 4"], directions: Float[np.ndarray, "N 3"]) -> Hits:
        """First hits of rays from a camera; directions in its axes, z = 1, so that a hit's parameter is its z-depth."""
        turned = rotated(directions, camera_to_world[:3, :3])
        triangle, z_depth, barycentric = self._rays.first_hits(camera_to_world[:3, 3], turned)
        return Hits(triangle >= 0, z_depth, np.maximum(triangle, 0), barycentric)

    def interpolate(self, values: Float[np.ndarray, "V K"], hits: Hits) -> Float[np.ndarray, "N K"]:
        """Interpolate vertex values at hits."""
        corners = self._triangles[hits.triangle]
        second, third = hits.barycentric[:, :1], hits.barycentric[:, 1:]
        return np.asarray(
            values[corners[:, 0]] * (1.0 - second - third)
            + values[corners[:, 1]] * second
            + values[corners[:, 2]] * third
        )

    def visible(
        self, points: Float[np.ndarray, "N 3"], viewpoints: Float[np.ndarray, "3"] | Float[np.ndarray, "N 3"]
    ) -> Bool[np.ndarray, "N"]:
        """Return which points on the wall are visible from viewpoints off it.

        The last thousandth of the ray is ignored, as the point is on the wall itself.
        """
        return ~self._rays.blocked(viewpoints, points - viewpoints)

    def clearance(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
        """Distance to the nearest wall, mm."""
        return self._rays.distance(points)


def seen_from(
    points: Float[np.ndarray, "N 3"],
    cameras_to_world: Sequence[Float[np.ndarray, "4 4"]],
    lens: Lens,
    mask: Bool[np.ndarray, "H W"],
    tracer: Tracer,
) -> Bool[np.ndarray, "N"]:
    """Return which points of the wall at least one camera sees: it projects to a lit pixel and is not occluded.

    Seen points are not tested again: give the poses that are likeliest to see the points first.
    """
    seen = np.zeros(len(points), bool)
    open_points = np.arange(len(points))
    for camera_to_world in cameras_to_world:
        if not len(open_points):
            break
        local = (points[open_points] - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
        candidates = open_points[lens.shows(local, mask)]
        visible = tracer.visible(points[candidates], camera_to_world[:3, 3])
        seen[candidates[visible]] = True
        open_points = open_points[~seen[open_points]]
    return seen


def nearest_poses_first(
    camera_to_world: Float[np.ndarray, "4 4"], others: Sequence[Float[np.ndarray, "4 4"]]
) -> list[Float[np.ndarray, "4 4"]]:
    """Other poses, sorted by distance and viewing angle (1 mm counts like 1 degree)."""
    stack = np.stack(others)
    apart = np.linalg.norm(stack[:, :3, 3] - camera_to_world[:3, 3], axis=1)
    rotated = np.degrees(np.arccos(np.clip(stack[:, :3, 2] @ camera_to_world[:3, 2], -1.0, 1.0)))
    return [others[index] for index in np.argsort(apart + rotated, kind="stable")]
