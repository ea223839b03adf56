"""Light source and reflectance of the wall, in linear light (docs/phantom.md 2, 2.2).

The unit of radiance is that of a white Lambertian wall at 20 mm, perpendicular to the lamp's axis, so that exposures
are of the order of 1.

A lamp on the optical axis casts no shadows. At the lens, its shadows are invisible to the lens. Behind the lens it
models a ring of light guides around it (such a ring, too, gains less than 1/d^2 on close walls, docs/phantom.md 2.1),
which lights all that the lens sees. A lamp beside the lens casts shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.phantom.colon import RADIUS, ColonSurface, Tracer, around_the_colon
from coliags_plugin.phantom.settings import PhantomSettings, SpreadLaw
from coliags_plugin.phantom.streams import smoothstep

#: Distance at which radiance is 1, mm.
UNIT_DISTANCE = 20.0
#: cos psi below which the beam fades to 0 at 90 degrees: light guides only emit forward. No pinhole looks there.
_EDGE = float(np.cos(np.radians(72.0)))
#: Normal reflectance of the mucus film: an index of refraction of 1.40.
F0 = 0.028


@dataclass(frozen=True)
class CameraLight:
    """A spotlight fixed to the camera, and how the mucosa reflects it; see :class:`PhantomSettings`."""

    offset: tuple[float, float, float]  # camera axes, mm
    axis: tuple[float, float, float]  # unit direction of the beam, camera axes
    spread_law: SpreadLaw
    spread: float
    specular: float
    roughness: float
    f0: float
    diffuse_roughness: float = 0.0  # degrees
    share: float = 1.0  # of the light of all lamps

    @classmethod
    def all_of(cls, settings: PhantomSettings) -> tuple[CameraLight, ...]:
        """Lamps from settings; their axis is the real endoscope's, or tilted downwards; their shares sum to 1."""
        preset, real = settings.light_preset, settings.real_endoscope
        tilt = np.radians(preset.tilt)
        offsets = settings.lamps or (settings.light_offset or (0.0, 0.0, 0.0),)
        shares = settings.lamp_shares or (1.0,) * len(offsets)
        return tuple(
            cls(
                offset=offset,
                axis=real.axis if real else (0.0, float(np.sin(tilt)), float(np.cos(tilt))),
                spread_law=preset.spread_law,
                spread=preset.spread,
                specular=settings.specular,
                roughness=settings.roughness,
                f0=F0,
                diffuse_roughness=settings.diffuse_roughness,
                share=share / sum(shares),
            )
            for offset, share in zip(offsets, shares, strict=True)
        )

    @property
    def casts_shadows(self) -> bool:
        """Return whether the lamp is off the optical axis."""
        return bool(np.hypot(self.offset[0], self.offset[1]) > 0.0)

    def beam(self, cosine: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """Intensity at an angle psi from the beam's axis by its cosine, 1 on the axis (docs/phantom.md 2)."""
        if self.spread_law == "cosine":
            shape = np.maximum(cosine, 0.0) ** self.spread
        else:
            shape = np.exp(-self.spread * (1.0 - cosine))
        return np.asarray(shape * smoothstep(cosine / _EDGE), dtype=cosine.dtype)

    def position(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """The lamp's position in the world, mm."""
        return np.asarray(camera_to_world[:3, 3] + camera_to_world[:3, :3] @ np.asarray(self.offset))

    def irradiance(
        self, points: Float[np.ndarray, "N 3"], camera_to_world: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
        """Irradiance of surfaces perpendicular to the light, and unit directions to the lamp; world, mm.

        The irradiance is ``share beam(cos psi) (20 / d)^2``.
        """
        lamp = self.position(camera_to_world).astype(points.dtype)
        axis = (camera_to_world[:3, :3] @ np.asarray(self.axis)).astype(points.dtype)
        to_lamp = lamp - points
        square = np.einsum("nc,nc->n", to_lamp, to_lamp)
        to_lamp /= np.sqrt(square)[:, None]
        return self.beam(-np.einsum("nc,c->n", to_lamp, axis)) * (self.share * UNIT_DISTANCE**2 / square), to_lamp

    def diffuse(
        self, normals: Float[np.ndarray, "N 3"], to_lamp: Float[np.ndarray, "N 3"], to_eye: Float[np.ndarray, "N 3"]
    ) -> Float[np.ndarray, "N"]:
        """Pi times the diffuse reflection of a white wall times n.l: radiance per unit of :meth:`irradiance`.

        Lambert's law, n.l, or the qualitative model of Oren and Nayar (1994) of V-shaped facets whose slope angles have
        the standard deviation ``diffuse_roughness``, which reflect more to where the light comes from.
        """
        light = np.maximum(np.einsum("nc,nc->n", normals, to_lamp), 0.0)
        if self.diffuse_roughness == 0.0:
            return np.asarray(light)
        variance = np.radians(self.diffuse_roughness) ** 2
        eye = np.maximum(np.einsum("nc,nc->n", normals, to_eye), 0.0)
        # sin theta_i sin theta_r cos(phi_i - phi_r), and sin alpha tan beta / (sin theta_i sin theta_r).
        around = np.maximum(np.einsum("nc,nc->n", to_lamp, to_eye) - light * eye, 0.0)
        steeper = around / np.maximum(np.maximum(light, eye), 1e-3)
        flat, retro = 1.0 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)
        return np.asarray(light * (flat + retro * steeper), dtype=light.dtype)

    def gloss(
        self,
        normals: Float[np.ndarray, "N 3"],
        to_lamp: Float[np.ndarray, "N 3"],
        to_eye: Float[np.ndarray, "N 3"],
        slope_variance: Float[np.ndarray, "N"],
    ) -> Float[np.ndarray, "N"]:
        """Pi times the GGX reflection of the film times n.l: radiance per unit of :meth:`irradiance`.

        Smith's height-correlated masking and Schlick's Fresnel term, of unit vectors. The slope variance of relief
        smaller than the sample, summed over two directions, widens the lobe like roughness (a GGX lobe of width alpha
        has slope variance alpha^2).
        """
        half = to_lamp + to_eye
        half /= np.maximum(np.sqrt(np.einsum("nc,nc->n", half, half)), 1e-6)[:, None]
        light = np.maximum(np.einsum("nc,nc->n", normals, to_lamp), 0.0)
        eye = np.maximum(np.einsum("nc,nc->n", normals, to_eye), 1e-3)
        facing = np.maximum(np.einsum("nc,nc->n", normals, half), 0.0)
        grazing = np.maximum(np.einsum("nc,nc->n", to_lamp, half), 0.0)
        alpha2 = np.minimum(self.roughness**4 + slope_variance, 1.0)
        lobe = alpha2 / (facing * facing * (alpha2 - 1.0) + 1.0) ** 2
        masking = light * np.sqrt(eye * eye * (1.0 - alpha2) + alpha2)
        masking += eye * np.sqrt(light * light * (1.0 - alpha2) + alpha2)
        fresnel = self.f0 + (1.0 - self.f0) * (1.0 - grazing) ** 5
        return np.asarray(self.specular * fresnel * lobe * 0.5 * light / np.maximum(masking, 1e-6))

    def describe(self) -> dict[str, Any]:
        """Parameters as plain values, for the truth folder; without those of a Lambertian wall and of one lamp."""
        plain = {"diffuse_roughness": 0.0, "share": 1.0}
        record = {name: value for name, value in asdict(self).items() if value != plain.get(name)}
        return {**record, "unit_distance_mm": UNIT_DISTANCE}


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
        y = np.clip(row * self.rows_per_row - 0.5, 0.0, len(self.irradiance) - 1.001)
        return around_the_colon(self.irradiance, y, column * self.columns_per_column - 0.5)


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
    lamps: Sequence[CameraLight],
    cameras_to_world: Float[np.ndarray, "T 4 4"],
    share: float,
    generator: np.random.Generator,
) -> list[IndirectLight]:
    """Indirect light for every camera pose, times a factor ``share``."""
    patches = make_patches(surface, vertex_albedo, generator)
    factors = form_factors(patches, surface.tracer)
    flat_points, flat_normals = patches.points.reshape(-1, 3), patches.normals.reshape(-1, 3)
    direct = np.zeros((len(patches.areas), len(cameras_to_world)))
    for index, camera_to_world in enumerate(cameras_to_world):
        for lamp in lamps:
            strength, to_lamp = lamp.irradiance(flat_points, camera_to_world)
            received = strength * np.maximum(np.einsum("nc,nc->n", flat_normals, to_lamp), 0.0)
            # Visibility is from the lens even if the lamp is behind it: see light.py on rings of light guides.
            source = lamp.position(camera_to_world) if lamp.casts_shadows else camera_to_world[:3, 3]
            lit = np.flatnonzero(received > 0.0)
            received[lit] *= surface.tracer.visible(flat_points[lit], source)
            direct[:, index] += received.reshape(-1, _SAMPLES).mean(axis=1)
    solved = share * solve(patches, factors, direct)
    rows, columns = patches.shape
    return [
        IndirectLight(light.reshape(rows, columns, 3), rows / surface.rows, columns / surface.columns)
        for light in solved
    ]
