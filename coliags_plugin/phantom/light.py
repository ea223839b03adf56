"""Light source and reflectance of the wall, in linear light (docs/phantom.md 2, 2.2).

The unit of radiance is that of a white Lambertian wall at 20 mm, perpendicular to the lamp's axis, so that exposures
are of the order of 1.

A lamp on the optical axis casts no shadows. At the lens, its shadows are invisible to the lens. Behind the lens it
models a ring of light guides around it (such a ring, too, gains less than 1/d^2 on close walls, docs/phantom.md 2.1),
which lights all that the lens sees. A lamp beside the lens casts shadows.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.lighting.beams import SpreadLaw, beam
from coliags_plugin.phantom.settings import PhantomSettings, value_or_default

#: Distance at which radiance is 1, mm.
UNIT_DISTANCE = 20.0


@dataclass(frozen=True)
class CameraLight:
    """A spotlight fixed to the camera, and the mucosa's specular reflection; see :class:`PhantomSettings`."""

    offset: tuple[float, float, float]  # camera axes, mm
    axis: tuple[float, float, float]  # unit direction of the beam, camera axes
    spread_law: SpreadLaw
    spread: float
    specular: float
    roughness: float
    f0: float

    @classmethod
    def of(cls, settings: PhantomSettings) -> CameraLight:
        """Lamp from settings; it is tilted downwards in the image."""
        preset = settings.light_preset
        tilt = np.radians(value_or_default(settings.tilt, preset.tilt))
        return cls(
            offset=value_or_default(settings.light_offset, preset.light_offset),
            axis=(0.0, float(np.sin(tilt)), float(np.cos(tilt))),
            spread_law=value_or_default(settings.spread_law, preset.spread_law),
            spread=value_or_default(settings.spread, preset.spread),
            specular=settings.specular,
            roughness=settings.roughness,
            f0=settings.f0,
        )

    @property
    def casts_shadows(self) -> bool:
        """Whether the lamp is off the optical axis."""
        return bool(np.hypot(self.offset[0], self.offset[1]) > 0.0)

    def beam(self, cosine: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """Intensity at an angle psi from the beam's axis by its cosine, 1 on the axis."""
        return beam(cosine, self.spread_law, self.spread)

    def irradiance(
        self, points: Float[np.ndarray, "N 3"], camera_to_world: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
        """Irradiance of surfaces perpendicular to the light, and unit directions to the lamp; world, mm.

        The irradiance is ``beam(cos psi) (20 / d)^2``.
        """
        rotation, center = camera_to_world[:3, :3], camera_to_world[:3, 3]
        lamp = (center + rotation @ np.asarray(self.offset)).astype(points.dtype)
        axis = (rotation @ np.asarray(self.axis)).astype(points.dtype)
        to_lamp = lamp - points
        square = np.einsum("nc,nc->n", to_lamp, to_lamp)
        to_lamp /= np.sqrt(square)[:, None]
        return self.beam(-np.einsum("nc,c->n", to_lamp, axis)) * (UNIT_DISTANCE**2 / square), to_lamp

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
        """Parameters as plain values, for the truth folder."""
        return {**asdict(self), "unit_distance_mm": UNIT_DISTANCE}
