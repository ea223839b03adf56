"""Diffuse interreflections of the wall, by radiosity.

A colon is nearly a closed cavity, and its mucosa reflects most of the red light, so that multiple bounces matter. This
is why the far lumen of a real image is a deep red-brown and not black, and why red falls off more slowly with distance
than green and blue (linear exponents 1.4 against 2.2 and 2.4, measured on C3VD; docs/phantom.md 2.3). The wall is
divided into Lambertian patches of about 5 mm with ray-traced mutual visibility.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.phantom.colon import RADIUS, ColonSurface
from coliags_plugin.phantom.light import CameraLight
from coliags_plugin.phantom.tracing import Tracer

_PATCH = 5.0
#: Sample points per patch.
_SAMPLES = 4
#: Bounces; at an albedo of .8 the rest is under 1 %.
_BOUNCES = 24
#: Pairs of points whose visibility is traced together, which bounds memory.
_AT_ONCE = 1 << 19


@dataclass(frozen=True)
class IndirectLight:
    """Indirect irradiance on a coarse grid over the colon, for one place of the lamp, in the unit of :mod:`light`."""

    irradiance: Float[np.ndarray, "R C 3"]
    rows_per_row: float  # patches per row of the mesh
    columns_per_column: float  # likewise

    def at(self, row: Float[np.ndarray, "N"], column: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
        """Bilinear interpolation between patch centres; columns are periodic."""
        rows, columns = self.irradiance.shape[:2]
        y = np.clip(row * self.rows_per_row - 0.5, 0.0, rows - 1.001)
        x = column * self.columns_per_column - 0.5
        top, left = y.astype(np.int64), np.floor(x).astype(np.int64)
        down, right = (y - top).astype(np.float32)[:, None], (x - left).astype(np.float32)[:, None]
        a, b = left % columns, (left + 1) % columns
        flat, upper = self.irradiance.reshape(-1, 3), top * columns
        lower = upper + columns
        above = flat[upper + a] * (1.0 - right) + flat[upper + b] * right
        below = flat[lower + a] * (1.0 - right) + flat[lower + b] * right
        return np.asarray(above * (1.0 - down) + below * down)


@dataclass(frozen=True)
class Patches:
    """Patches of the wall."""

    points: Float[np.ndarray, "P K 3"]  # sample points, world, mm
    normals: Float[np.ndarray, "P K 3"]  # unit, into the lumen
    areas: Float[np.ndarray, "P"]  # mm^2
    albedo: Float[np.ndarray, "P 3"]  # linear RGB
    shape: tuple[int, int]  # rows and columns; P is their product


def make_patches(
    surface: ColonSurface, vertex_albedo: Float[np.ndarray, "V 3"], generator: np.random.Generator
) -> Patches:
    """Divide the wall into a grid of patches, each represented by a few of its vertices."""
    rows = min(max(round(surface.row_length * (surface.rows - 1) / _PATCH), 4), surface.rows)
    columns = min(max(round(2.0 * np.pi * RADIUS / _PATCH), 6), surface.columns)
    row_of = (np.arange(surface.rows) * rows) // surface.rows
    column_of = (np.arange(surface.columns) * columns) // surface.columns
    patch_of = (row_of[:, None] * columns + column_of[None, :]).ravel()
    areas = np.bincount(patch_of, surface.areas, rows * columns)
    reflecting = [np.bincount(patch_of, channel * surface.areas, rows * columns) for channel in vertex_albedo.T]
    albedo = np.stack(reflecting, axis=1) / np.maximum(areas, 1e-9)[:, None]
    order = np.argsort(patch_of, kind="stable")
    first = np.searchsorted(patch_of[order], np.arange(rows * columns))
    count = np.bincount(patch_of, minlength=rows * columns)
    chosen = order[first[:, None] + (generator.random((rows * columns, _SAMPLES)) * count[:, None]).astype(np.int64)]
    return Patches(
        surface.vertices[chosen].astype(np.float64),
        surface.normals[chosen].astype(np.float64),
        areas,
        albedo,
        (rows, columns),
    )


def form_factors(patches: Patches, tracer: Tracer) -> Float[np.ndarray, "P P"]:
    """Form factors from patch j to patch i.

    The form factor of a small disc of area A is ``cos cos A / (pi r^2 + A)``, averaged over pairs of samples.
    """
    count = len(patches.areas)
    total = np.zeros((count, count))
    for sample in range(_SAMPLES):
        receiver, emitter = patches.points[:, sample], patches.points[:, (sample + 1) % _SAMPLES]
        up, emitted = patches.normals[:, sample], patches.normals[:, (sample + 1) % _SAMPLES]
        apart = emitter[None] - receiver[:, None]
        square = np.einsum("ijc,ijc->ij", apart, apart)
        distance = np.sqrt(np.maximum(square, 1e-12))
        leaving = np.einsum("ijc,ic->ij", apart, up) / distance
        arriving = -np.einsum("ijc,jc->ij", apart, emitted) / distance
        i, j = np.nonzero((leaving > 0.0) & (arriving > 0.0))
        clear = np.zeros(len(i), bool)
        for start in range(0, len(i), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            # Offset from the wall to avoid self-occlusion.
            clear[part] = tracer.visible(emitter[j[part]], receiver[i[part]] + 0.05 * up[i[part]])
        i, j = i[clear], j[clear]
        area = patches.areas[j]
        total[i, j] += leaving[i, j] * arriving[i, j] * area / (np.pi * square[i, j] + area)
    total /= _SAMPLES
    np.fill_diagonal(total, 0.0)
    # The form factors of a patch sum to at most 1.
    return np.asarray(total / np.maximum(total.sum(axis=1, keepdims=True), 1.0))


def solve(
    patches: Patches, factors: Float[np.ndarray, "P P"], direct: Float[np.ndarray, "P T"]
) -> Float[np.ndarray, "T P 3"]:
    """Solve for the indirect irradiance of T lamps at once, from the direct irradiance of each (white) lamp."""
    answer = np.empty((direct.shape[1], direct.shape[0], 3), np.float32)
    for channel in range(3):
        albedo = patches.albedo[:, channel, None]
        received = np.zeros_like(direct)
        for _ in range(_BOUNCES):
            received = factors @ (albedo * (direct + received))
        answer[..., channel] = received.T
    return answer


def indirect_lights(
    surface: ColonSurface,
    vertex_albedo: Float[np.ndarray, "V 3"],
    tracer: Tracer,
    lamps: Sequence[CameraLight],
    cameras_to_world: Sequence[Float[np.ndarray, "4 4"]],
    share: float,
    generator: np.random.Generator,
) -> list[IndirectLight]:
    """Indirect light for every camera pose, times a factor ``share``."""
    patches = make_patches(surface, vertex_albedo, generator)
    factors = form_factors(patches, tracer)
    flat_points, flat_normals = patches.points.reshape(-1, 3), patches.normals.reshape(-1, 3)
    direct = np.zeros((len(patches.areas), len(cameras_to_world)))
    for index, camera_to_world in enumerate(cameras_to_world):
        for lamp in lamps:
            strength, to_lamp = lamp.irradiance(flat_points, camera_to_world)
            received = strength * np.maximum(np.einsum("nc,nc->n", flat_normals, to_lamp), 0.0)
            # Visibility is from the lens even if the lamp is behind it: see light.py on rings of light guides.
            source = lamp.position(camera_to_world) if lamp.casts_shadows else camera_to_world[:3, 3]
            lit = np.flatnonzero(received > 0.0)
            received[lit] *= tracer.visible(flat_points[lit], source)
            direct[:, index] += received.reshape(-1, _SAMPLES).mean(axis=1)
    solved = share * solve(patches, factors, direct)
    rows, columns = patches.shape
    return [
        IndirectLight(light.reshape(rows, columns, 3), rows / surface.rows, columns / surface.columns)
        for light in solved
    ]
