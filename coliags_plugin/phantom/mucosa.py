"""Procedural texture of the wall: albedo, wetness and micro-relief."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.phantom.colon import RADIUS, Anatomy, ColonSurface
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.phantom.streams import Purpose, SolidNoise, smoothstep, stream

#: Size, mm, and relative strength of the mottling of brightness.
_MOTTLING = ((6.0, 0.06), (1.6, 0.045), (0.4, 0.045), (0.18, 0.045))
#: Size, mm, and strength of variations in blood content, which absorb green and blue but hardly red.
_REDDENING = ((9.0, 0.09), (2.5, 0.10), (0.9, 0.06))
#: Absorption of a vessel's blood at full strength, per RGB channel (optical depth).
_BLOOD = (0.30, 0.95, 0.85)
#: Correlation length, mm, and slope (standard deviation, each direction) of the relief too small for the mesh.
_MICRO_RELIEF = ((0.8, 0.04), (0.24, 0.085))
#: Share of reddening that each RGB channel shows.
_REDDENED = (0.12, 1.0, 0.95)
#: Share of the mottling due to blood content, so that darker regions are also redder.
_MOTTLED = (0.7, 1.2, 1.15)
_VESSELS = 120
_LEVELS = 6


@dataclass(frozen=True)
class MucosaSample:
    """The wall's material at N points."""

    albedo: Float[np.ndarray, "N 3"]  # linear RGB
    wetness: Float[np.ndarray, "N"]  # coverage by the mucus film, 0 to 1
    slopes: Float[np.ndarray, "N 2"]  # micro-relief along the colon and around it, rise per run
    slope_variance: Float[np.ndarray, "N"]  # filtered out within the footprint, both directions summed


@dataclass(frozen=True)
class Mucosa:
    """Mipmapped texture; columns are periodic."""

    color: tuple[Float[np.ndarray, "H W 4"], ...]  # albedo RGB and wetness, float32, per level
    relief: tuple[Float[np.ndarray, "H W 3"], ...]  # slopes along, around and their summed squares, per level
    texel: float  # size of a texel of level 0, mm
    rows_per_row: float  # texels of level 0 per row of the mesh
    columns_per_column: float  # likewise

    @property
    def albedo(self) -> Float[np.ndarray, "H W 3"]:
        """The full-size albedo texture, linear RGB."""
        return self.color[0][:, 1:-1, :3]

    def sample(
        self, row: Float[np.ndarray, "N"], column: Float[np.ndarray, "N"], footprint: Float[np.ndarray, "N"]
    ) -> MucosaSample:
        """Sample the material at fractional rows and columns of the mesh, filtered to a sample's footprint, mm."""
        level = np.clip(np.log2(np.maximum(footprint / self.texel, 1.0)), 0.0, _LEVELS - 1.001).astype(np.float32)
        lower = level.astype(np.int32)
        fraction = level - lower
        out = np.zeros((len(row), 7), np.float32)
        for current in range(_LEVELS):
            weight = np.where(lower == current, 1.0 - fraction, np.where(lower == current - 1, fraction, 0.0))
            chosen = np.flatnonzero(weight)
            if not len(chosen):
                continue
            scale = 0.5**current
            # Texel centres are offset by half a texel from the grid lines, and there is one padding column.
            x = (column[chosen] * self.columns_per_column * scale) % (self.color[current].shape[1] - 2) + 0.5
            y = row[chosen] * self.rows_per_row * scale - 0.5
            values = [_look_up(level[current], x, y) for level in (self.color, self.relief)]
            out[chosen] += weight[chosen, None].astype(np.float32) * np.concatenate(values, axis=1)
        variance = np.clip(out[:, 6] - out[:, 4] ** 2 - out[:, 5] ** 2, 0.0, None)
        return MucosaSample(out[:, :3], out[:, 3], out[:, 4:6], variance)


def paint_mucosa(anatomy: Anatomy, surface: ColonSurface, settings: PhantomSettings) -> Mucosa:
    """Generate the texture: red-pink base, mottling, blood, branching vessels, mucus and micro-relief."""
    generator = stream(settings.seed, Purpose.MUCOSA)
    length = surface.row_length * (surface.rows - 1)
    around = 2.0 * np.pi * RADIUS
    # Sizes that halve _LEVELS - 1 times.
    multiple = 2 ** (_LEVELS - 1)
    height = multiple * (round(length / settings.texture_spacing / multiple) + 1)
    width = multiple * (round(around / settings.texture_spacing / multiple) + 1)
    solid = SolidNoise(generator)
    positions = _texel_positions(surface, (height, width))
    # Low-frequency layers are computed on every fourth texel.
    sparse = _texel_positions(surface, (height // 4, width // 4))

    def noise(scale: float) -> Float[np.ndarray, "H W"]:
        if scale < 1.4:
            return solid.layer(positions, scale)
        broad = np.pad(solid.layer(sparse, scale), ((0, 0), (1, 1)), mode="wrap")
        return np.asarray(cv2.resize(broad, (width + 8, height), interpolation=cv2.INTER_LINEAR)[:, 4:-4])

    arc = np.interp((np.arange(height) + 0.5) / height * (surface.rows - 1), np.arange(surface.rows), surface.arc)
    clock = (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    brightness = np.zeros((height, width), np.float32)
    for scale, strength in _MOTTLING:
        brightness += np.float32(strength) * noise(scale)
    blood = np.zeros((height, width), np.float32)
    for scale, strength in _REDDENING:
        blood += np.float32(strength) * noise(scale)
    # Small red spots where the noise peaks; lymphoid tissue and scars are the pale opposite.
    blood += 0.45 * smoothstep((noise(1.5) - 2.1) / 1.2).astype(np.float32)
    blood -= 0.14 * smoothstep((noise(5.0) - 1.0) / 1.2).astype(np.float32)
    for polyp in anatomy.polyps:
        rows = slice(*np.searchsorted(arc, [polyp.arc - polyp.width, polyp.arc + polyp.width]))
        blood[rows] += 0.30 * np.sqrt(polyp.nearness(arc[rows, None], clock[None, :])).astype(np.float32)
    vessels = _draw_vessels((height, width), (length / height, around / width), generator)
    color = np.empty((height, width, 4), np.float32)
    for channel, base in enumerate(settings.albedo):
        depth = _REDDENED[channel] * blood + _BLOOD[channel] * vessels - _MOTTLED[channel] * brightness
        color[..., channel] = np.clip(base * np.exp(-settings.texture * depth), 0.02, 0.95)
    color[..., 3] = 0.25 + 0.75 * smoothstep((noise(7.0) + 0.35 * noise(1.2) + 1.0) / 1.6)

    along = np.linalg.norm(np.gradient(positions, axis=0), axis=-1)
    across = np.linalg.norm(np.gradient(positions, axis=1), axis=-1)
    relief = np.zeros((height, width, 3), np.float32)
    for scale, slope in _MICRO_RELIEF:
        bumps = noise(scale)
        # A Gaussian process of kernel sigma has slopes of 1 / (sqrt(2) sigma); this keeps them uniform.
        rise = settings.texture * slope * np.sqrt(2.0) * scale / 2.5
        relief[..., 0] += rise * np.gradient(bumps, axis=0) / np.maximum(along, 1e-3)
        relief[..., 1] += rise * np.gradient(bumps, axis=1) / np.maximum(across, 1e-3)
    relief[..., 2] = relief[..., 0] ** 2 + relief[..., 1] ** 2
    return Mucosa(
        color=_pyramid(color),
        relief=_pyramid(relief),
        texel=length / height,
        rows_per_row=height / (surface.rows - 1),
        columns_per_column=width / surface.columns,
    )


def _texel_positions(surface: ColonSurface, shape: tuple[int, int]) -> Float[np.ndarray, "H W 3"]:
    """Texel centres in the world frame, mm."""
    grid = surface.vertices.reshape(surface.rows, surface.columns, 3)
    grid = np.concatenate([grid, grid[:, :1]], axis=1)
    row = (np.arange(shape[0], dtype=np.float32) + 0.5) * ((surface.rows - 1) / shape[0])
    column = (np.arange(shape[1], dtype=np.float32) + 0.5) * (surface.columns / shape[1])
    columns, rows = np.meshgrid(column, row)
    return np.asarray(cv2.remap(grid, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _draw_vessels(
    shape: tuple[int, int], sizes: tuple[float, float], generator: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """Vessel density at each texel, 0 to about 1.

    Vessels are random walks that taper and branch. Half are deep, blurred and attenuated by the tissue above.
    """
    pad = round(12.0 / sizes[1])
    layers = []
    for weakest, strongest, blur in ((90, 200, 0.06), (60, 150, 0.30)):
        canvas = np.zeros((shape[0], shape[1] + 2 * pad), np.uint8)
        for _ in range(_VESSELS // 2):
            start = generator.uniform([0.0, 0.0], [shape[0] * sizes[0], shape[1] * sizes[1]])
            heading = generator.uniform(0.0, 2.0 * np.pi)
            strength = int(generator.integers(weakest, strongest))
            width = generator.uniform(0.35, 0.6)
            _draw_branch(canvas, sizes, pad, start, heading, width, strength, generator, surfacing=5.0)
        folded = canvas[:, pad:-pad]
        folded[:, :pad] = np.maximum(folded[:, :pad], canvas[:, -pad:])
        folded[:, -pad:] = np.maximum(folded[:, -pad:], canvas[:, :pad])
        sigma = blur / sizes[0]
        wrapped = np.pad(folded, ((0, 0), (pad, pad)), mode="wrap").astype(np.float32) / 255.0
        layers.append(cv2.GaussianBlur(wrapped, (0, 0), max(sigma, 0.3))[:, pad:-pad])
    return np.maximum(layers[0], layers[1])


def _draw_branch(
    canvas: UInt8[np.ndarray, "H W"],
    sizes: tuple[float, float],
    pad: int,
    start: Float[np.ndarray, "2"],
    heading: float,
    width: float,
    strength: int,
    generator: np.random.Generator,
    surfacing: float = 0.0,
) -> None:
    """Draw one vessel (row, column in mm) and, recursively, its branches; all taper to 0.15 mm.

    Over its first ``surfacing`` mm a vessel rises from deep in the wall.
    """
    current, step, walked = start.copy(), 0.6, 0.0
    wander = 0.0
    around = (canvas.shape[1] - 2 * pad) * sizes[1]
    current[1] %= around
    taper = np.exp(-step / generator.uniform(22.0, 40.0))
    while width >= 0.15:
        wander = 0.8 * wander + generator.normal(0.0, 0.05)
        heading += wander + generator.normal(0.0, 0.10)
        following = current + step * np.array([np.cos(heading), np.sin(heading)])
        ends = [
            (round((point[1] / sizes[1] + pad) * 16), round(point[0] / sizes[0] * 16)) for point in (current, following)
        ]
        # Vessels thinner than a texel are drawn fainter.
        thickness = max(round(width / sizes[0]), 1)
        risen = min(walked / surfacing, 1.0) if surfacing else 1.0
        shown = round(strength * risen * min(width / sizes[0], 1.0) * min(1.0, width / 0.3))
        cv2.line(canvas, ends[0], ends[1], shown, thickness, cv2.LINE_AA, 4)
        current, walked = following, walked + step
        width *= taper
        if not -0.4 * pad * sizes[1] < current[1] < around + 0.4 * pad * sizes[1]:
            current[1] %= around
        if generator.uniform() < 0.05 and width > 0.22:
            side = generator.choice([-1.0, 1.0]) * generator.uniform(0.4, 0.9)
            _draw_branch(canvas, sizes, pad, current, heading + side, 0.75 * width, int(0.9 * strength), generator)
            heading -= 0.3 * side
            width *= 0.9


def _pyramid(texture: Float[np.ndarray, "H W K"]) -> tuple[Float[np.ndarray, "H W K"], ...]:
    """Mipmap levels by 2 x 2 means, with one periodic padding column at either edge."""
    levels = [texture]
    for _ in range(_LEVELS - 1):
        height, width, _ = levels[-1].shape
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return tuple(np.concatenate([level[:, -1:], level, level[:, :1]], axis=1) for level in levels)


def _look_up(
    texture: Float[np.ndarray, "H W K"], x: Float[np.ndarray, "N"], y: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N K"]:
    """Bilinear values, centres at integers, rows clamped."""
    # cv2.remap takes maps of at most 32767 per side.
    width = min(len(x), 4096)
    padded = -len(x) % width
    maps = [np.pad(axis.astype(np.float32), (0, padded)).reshape(-1, width) for axis in (x, y)]
    values = cv2.remap(texture, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.reshape(-1, texture.shape[2])[: len(x)])
