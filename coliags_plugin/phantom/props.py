"""Covers of the wall in an image: fluid, bubbles, a tool, and drops of water on the lens.

Bodies are triangle meshes, in the world or fixed to the camera, that are drawn over the radiance of the wall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from coliags_plugin.phantom.colon import ColonSurface, Tracer, around_the_colon, grid_triangles, rotated, unit
from coliags_plugin.phantom.light import CameraLight
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, stream

#: Absorption by fluid per mm, RGB, and the colour that it scatters.
_FLUID_ABSORPTION, _FLUID_ALBEDO = np.array([0.06, 0.09, 0.3]), np.array([0.62, 0.44, 0.14])
#: Arc lengths of the pool, mm, between which its ends run out into the wall.
_POOL, _POOL_END = (34.0, 96.0), 12.0
#: Radii of bubbles, mm, how many are in a cluster, its size, mm, and their speed along the colon, mm/s.
_BUBBLE, _CLUSTER, _SPREAD, _DRIFT = (0.35, 1.3), 12, 5.0, 1.5
#: Arc lengths at which bubbles are, mm.
_BUBBLES_AT = (30.0, 120.0)
#: Radius of the tool, mm, and where in camera axes it leaves its channel, mm.
_TOOL_RADIUS, _CHANNEL = 1.2, np.array([3.0, 3.6, 0.0])
#: Distance from the channel to the tool's tip, smallest and largest, mm, and period of its motion, s.
_TOOL_REACH, _TOOL_PERIOD = (4.0, 22.0), 5.0
_TOOL_ALBEDO = np.array([0.07, 0.075, 0.08])
#: Time that water stays on the lens, s, and how many drops there are.
_WASH_TIME, _DROPS = 1.2, 9


class Cover(IntEnum):
    """Pixel values of the masks of what is not wall."""

    WALL = 0
    FLUID = 64
    BUBBLE = 128
    DROP = 192
    TOOL = 255


@dataclass(frozen=True)
class Body:
    """A body over the wall."""

    cover: Cover
    tracer: Tracer
    normals: Float[np.ndarray, "V 3"]

    def draw(
        self,
        lamps: tuple[CameraLight, ...],
        vignetting: float,
        camera_to_world: Float[np.ndarray, "4 4"],
        directions: Float[np.ndarray, "N 3"],
        z_depth: Float[np.ndarray, "N"],
        light: Float[np.ndarray, "N 3"],
    ) -> Bool[np.ndarray, "N"]:
        """Draw it over ``light`` where it is nearer than ``z_depth``; changes both and returns where."""
        # The tool is in camera axes.
        pose = np.eye(4) if self.cover is Cover.TOOL else camera_to_world
        hits = self.tracer.cast(pose, directions)
        nearer = hits.found & (hits.z_depth < z_depth)
        if not nearer.any():
            return nearer
        hits, ahead = hits.only(nearer), directions[nearer]
        length = np.linalg.norm(ahead, axis=1)
        to_eye = rotated(ahead, pose[:3, :3]) / -length[:, None]
        points = pose[:3, 3].astype(np.float32) - to_eye * (hits.z_depth * length)[:, None]
        normals = self.tracer.interpolate(self.normals, hits)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        facing = np.einsum("nc,nc->n", normals, to_eye)
        normals *= np.sign(facing)[:, None]
        facing = np.abs(facing)
        flat = np.zeros(len(facing), np.float32)
        f0, roughness = {Cover.FLUID: (0.02, 0.2), Cover.BUBBLE: (0.04, 0.15), Cover.TOOL: (0.35, 0.45)}[self.cover]
        received, diffuse, gloss = (np.zeros((len(facing), 1), np.float32) for _ in range(3))
        for lamp in lamps:
            strength, to_lamp = lamp.irradiance(points, pose)
            strength *= length**-vignetting
            received += strength[:, None]
            diffuse += (strength * np.maximum(np.einsum("nc,nc->n", normals, to_lamp), 0.0))[:, None]
            surface = replace(lamp, f0=f0, roughness=roughness, specular=1.0)
            gloss += (strength * surface.gloss(normals, to_lamp, to_eye, flat))[:, None]
        if self.cover is Cover.TOOL:
            light[nearer] = _TOOL_ALBEDO * diffuse + gloss
        elif self.cover is Cover.BUBBLE:
            # A film that hides little from the front and much at its rim, where it also scatters.
            rim = (1.0 - facing[:, None]) ** 2
            light[nearer] = light[nearer] * (1.0 - 0.65 * rim) + 0.3 * rim * received + gloss
        else:
            depth = np.minimum(z_depth[nearer] - hits.z_depth, 100.0) * length
            clear = np.exp(-_FLUID_ABSORPTION * depth[:, None])
            light[nearer] = light[nearer] * clear + _FLUID_ALBEDO * (1.0 - clear) * diffuse + gloss
        z_depth[nearer] = hits.z_depth
        return nearer


#: Vertices, their unit normals, and triangles.
Parts = tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]


def bodies_at(surface: ColonSurface, settings: PhantomSettings, time: float) -> tuple[Body, ...]:
    """The bodies at a time, s, over the wall as it then is; farther ones first."""
    makers: tuple[tuple[bool, Cover, Callable[[ColonSurface, PhantomSettings, float], Parts]], ...] = (
        (settings.fluid > 0.0, Cover.FLUID, _pool),
        (settings.bubbles > 0, Cover.BUBBLE, _bubbles),
        (settings.tool, Cover.TOOL, _tool),
    )
    bodies = []
    for is_there, cover, make in makers:
        if is_there:
            vertices, normals, triangles = make(surface, settings, time)
            tracer = Tracer(vertices.astype(np.float32), triangles)
            bodies.append(Body(cover, tracer, normals.astype(np.float32)))
    return tuple(bodies)


def _pool(surface: ColonSurface, settings: PhantomSettings, time: float) -> Parts:
    """The level surface of a pool on one side of the colon, with ripples."""
    generator = stream(settings.seed, Purpose.PROPS, 0)
    clock = round(generator.uniform(0.0, surface.columns))
    grid = surface.vertices.reshape(surface.rows, surface.columns, 3).astype(np.float64)
    rows = np.flatnonzero((surface.arc > _POOL[0]) & (surface.arc < _POOL[1]))[::2]
    arc = surface.arc[rows]
    # A straight axis, so that the surface is level.
    centres = np.polynomial.polynomial.polyval(arc, np.polynomial.polynomial.polyfit(arc, grid[rows].mean(axis=1), 1)).T
    down = grid[rows, clock % surface.columns] - grid[rows, (clock + surface.columns // 2) % surface.columns]
    down = unit(down.mean(axis=0))
    side = unit(np.cross(down, centres[-1] - centres[0]))
    # Deep enough that, at the ends of the pool, the wall rises above it.
    lowest = float(np.max((grid[rows] - centres[:, None]) @ down))
    ends = np.clip(1.0 - np.minimum(arc - _POOL[0], _POOL[1] - arc) / _POOL_END, 0.0, 1.0)
    height = lowest - settings.fluid + (settings.fluid + 2.0) * ends**2
    across = np.linspace(-26.0, 26.0, 105)
    points = (centres + height[:, None] * down)[:, None] + across[None, :, None] * side
    phase = generator.uniform(0.0, 2.0 * np.pi, 3)
    slope = np.zeros(points.shape[:2])
    for scale, speed, turn in ((5.0, 9.0, phase[0]), (8.0, 12.0, phase[1]), (3.1, 7.0, phase[2])):
        along = arc[:, None] * np.cos(turn) + across[None, :] * np.sin(turn)
        slope += 0.03 * np.sin(2.0 * np.pi * (along - speed * time) / scale)
    normals = unit(-down + slope[:, :, None] * side + slope[:, ::-1, None] * np.cross(side, down))
    triangles = grid_triangles(len(rows), len(across), "acb cdb", wraps=False)
    return points.reshape(-1, 3), normals.reshape(-1, 3), triangles


def _bubbles(surface: ColonSurface, settings: PhantomSettings, time: float) -> Parts:
    """Bubbles in clusters on the wall, which drift along it towards the shallow end."""
    generator = stream(settings.seed, Purpose.PROPS, 1)
    count = settings.bubbles
    clusters = -(-count // _CLUSTER)
    cluster = np.arange(count) % clusters
    arc = generator.uniform(*_BUBBLES_AT, clusters)[cluster] + generator.normal(0.0, 0.5 * _SPREAD, count)
    clock = generator.uniform(0.0, 2.0 * np.pi, clusters)[cluster] + generator.normal(0.0, 0.025 * _SPREAD, count)
    radius = _BUBBLE[0] * (_BUBBLE[1] / _BUBBLE[0]) ** generator.uniform(size=count)
    speed = _DRIFT * generator.uniform(0.5, 1.5, clusters)[cluster]
    row = np.interp(arc - speed * time, surface.arc, np.arange(surface.rows))
    column = (clock / (2.0 * np.pi) * surface.columns) % surface.columns
    shape = (surface.rows, surface.columns, 3)
    grids = (values.reshape(shape).astype(np.float64) for values in (surface.vertices, surface.normals))
    foot, normal = (around_the_colon(grid, row, column) for grid in grids)
    centres = foot + 0.5 * radius[:, None] * unit(normal)
    sphere, triangles = _sphere()
    vertices = centres[:, None] + radius[:, None, None] * sphere
    triangles = triangles[None] + len(sphere) * np.arange(count)[:, None, None]
    return vertices.reshape(-1, 3), np.tile(sphere, (count, 1)), triangles.reshape(-1, 3).astype(np.uint32)


def _tool(surface: ColonSurface, settings: PhantomSettings, time: float) -> Parts:
    """A rod with a round end, in camera axes, that moves in and out of its channel and swings."""
    phase = stream(settings.seed, Purpose.PROPS, 2).uniform(0.0, 2.0 * np.pi, 3)
    low, high = _TOOL_REACH
    turn = 2.0 * np.pi * time / _TOOL_PERIOD
    reach = low + (high - low) * (0.5 - 0.5 * np.cos(turn + phase[0]))
    swing = 0.06 * np.sin(np.array([1.7, 1.3]) * turn + phase[1:])
    aim = unit(np.array([swing[0] - 0.12, swing[1] - 0.16, 1.0]))
    sphere, triangles = _sphere()
    # A sphere whose rear half is drawn out behind the lens.
    behind = sphere[:, 2] < 0.0
    vertices = _TOOL_RADIUS * sphere
    vertices[behind, 2] = -60.0
    normals = np.where(behind[:, None], sphere * [1.0, 1.0, 0.0], sphere)
    side = unit(np.cross([0.0, 1.0, 0.0], aim))
    axes = np.stack([side, np.cross(aim, side), aim], axis=1)
    return _CHANNEL + reach * aim + vertices @ axes.T, unit(normals + 1e-9) @ axes.T, triangles


def _sphere() -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices and triangles of the unit sphere by latitude and longitude."""
    bands, sectors = 12, 24
    theta = np.linspace(0.0, np.pi, bands + 1)[:, None]
    phi = np.arange(sectors) * (2.0 * np.pi / sectors)
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], axis=-1)
    return points.reshape(-1, 3).astype(np.float32), grid_triangles(bands + 1, sectors, "abc cbd")


def wet_lens(
    image: Float[np.ndarray, "H W 3"], cover: UInt8[np.ndarray, "H W"], settings: PhantomSettings, time: float
) -> tuple[Float[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
    """An image, and its mask, through the drops that a wash leaves on the lens: each shows what is around it, small."""
    seconds = settings.frames / settings.frame_rate
    for wash in range(settings.washes):
        generator = stream(settings.seed, Purpose.PROPS, 3, wash)
        age = time - (wash + generator.uniform(0.3, 0.7)) / settings.washes * seconds
        if not 0.0 <= age < _WASH_TIME:
            continue
        height, width = cover.shape
        column, row = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        x, y = column.copy(), row.copy()
        for _ in range(_DROPS):
            centre = generator.uniform(-0.1, 1.1, 2) * [width, height]
            velocity = generator.normal(0.0, 0.12, 2) * width
            radius = generator.uniform(0.05, 0.2) * width * (1.0 - age / _WASH_TIME) ** 0.5
            away = column - np.float32(centre[0] + age * velocity[0]), row - np.float32(centre[1] + age * velocity[1])
            inside = away[0] ** 2 + away[1] ** 2 < radius**2
            bent = 1.0 - 1.6 * np.sqrt(np.clip(1.0 - (away[0] ** 2 + away[1] ** 2) / max(radius, 1e-3) ** 2, 0.0, 1.0))
            x[inside] += ((bent - 1.0) * away[0])[inside]
            y[inside] += ((bent - 1.0) * away[1])[inside]
            cover = np.where(inside, np.uint8(Cover.DROP), cover)
        through = cv2.GaussianBlur(image, (0, 0), max(0.006 * width, 0.3))
        through = cv2.remap(through, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        image = np.where((cover == Cover.DROP)[..., None], through, image)
    return image, cover
