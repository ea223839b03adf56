"""Ray-traced rendering of the mesh through a lens: radiance and z-depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.phantom.colon import ColonSurface
from coliags_plugin.phantom.light import CameraLight, IndirectLight
from coliags_plugin.phantom.mucosa import Mucosa
from coliags_plugin.phantom.props import Body
from coliags_plugin.phantom.tracing import Hits, Tracer, rotated

#: Samples shaded per batch, which bounds memory and fits the cache.
_CHUNK = 1 << 15


@dataclass(frozen=True)
class Sensor:
    """The lit pixels and their ray directions."""

    lens: Lens
    mask: Bool[np.ndarray, "H W"]  # lit pixels
    centers: Float[np.ndarray, "P 3"]  # ray direction through each lit pixel's centre
    samples: Float[np.ndarray, "P K 3"]  # directions of its K colour samples

    @property
    def focal_length(self) -> float:
        """Pixels per radian near the middle of the image."""
        return float(1.0 / np.sqrt(_pixel_solid_angle(self)))

    @classmethod
    def behind(cls, lens: Lens, mask: Bool[np.ndarray, "H W"], supersampling: int) -> Sensor:
        """A sensor with ``supersampling`` x ``supersampling`` colour samples per pixel."""
        row, column = np.nonzero(mask)
        pixels = np.stack([column, row], axis=1) + 0.5
        reached = ~np.isnan(lens.unproject(pixels)[:, 0])
        mask = mask.copy()
        mask[row, column] = reached
        pixels = pixels[reached]
        offsets = (np.arange(supersampling) + 0.5) / supersampling - 0.5
        sub = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
        centers = lens.unproject(pixels)
        samples = np.stack([lens.unproject(pixels + offset) for offset in sub], axis=1)
        # A sub-sample outside the lens's field of view uses the direction of its pixel's centre.
        samples = np.where(np.isnan(samples), centers[:, None, :], samples)
        return cls(lens, mask, centers.astype(np.float32), samples.astype(np.float32))

    def subsampled(self, most: int) -> Sensor:
        """A sparse sensor for exposure metering: about ``most`` evenly spread pixels, one sample each."""
        stride = max(int(np.sqrt(len(self.centers) / most)), 1)
        grid = np.zeros_like(self.mask)
        grid[stride // 2 :: stride, stride // 2 :: stride] = True
        mask = self.mask & grid
        chosen = self.centers[mask[self.mask]]
        return Sensor(self.lens, mask, chosen, chosen[:, None, :])

    def softened(self, values: Float[np.ndarray, "P 3"], sigma: float) -> Float[np.ndarray, "P 3"]:
        """Values blurred by a Gaussian among the lit pixels, sigma in pixels."""
        weight = cv2.GaussianBlur(self.mask.astype(np.float32), (0, 0), sigma)
        blurred = cv2.GaussianBlur(self.image(values), (0, 0), sigma)
        return np.asarray(blurred[self.mask] / weight[self.mask][:, None])

    def image(self, values: np.ndarray) -> np.ndarray:
        """Scatter values of the lit pixels to an image that is 0 elsewhere."""
        image = np.zeros((*self.mask.shape, *values.shape[1:]), values.dtype)
        image[self.mask] = values
        return image


@dataclass(frozen=True)
class World:
    """Scene description: wall, material, lamps and lens, without the camera pose."""

    surface: ColonSurface
    mucosa: Mucosa
    tracer: Tracer
    lamps: tuple[CameraLight, ...]
    vignetting: float
    bodies: tuple[Body, ...] = ()  # over the wall, farther ones first


@dataclass(frozen=True)
class Exposure:
    """Rendered values of the sensor's P lit pixels."""

    radiance: Float[np.ndarray, "P 3"]  # linear, before exposure
    z_depth: Float[np.ndarray, "P"]  # mm at the pixel's centre; 0 where the ray hits nothing
    triangles: Int[np.ndarray, "T"]  # indices of all triangles hit
    hits: Hits  # of the pixels' centres
    cover: UInt8[np.ndarray, "P"]  # what is over the wall there, see Cover


def expose(
    world: World,
    sensor: Sensor,
    camera_to_world: Float[np.ndarray, "4 4"],
    indirect: IndirectLight | None,
    during: Sequence[Float[np.ndarray, "4 4"]] = (),
) -> Exposure:
    """Render one image. Colour is the mean of a pixel's samples; z-depth and cover are those of its centre.

    With poses ``during`` the exposure, it is the mean over these, of one sample of a pixel each in turn.
    """
    pixels, per_pixel = sensor.samples.shape[:2]
    radiance = np.empty((pixels, 3), np.float32)
    met = np.zeros(len(world.surface.triangles), bool)
    # Distance between neighbouring samples per mm of depth.
    spacing = float(np.sqrt(_pixel_solid_angle(sensor) / per_pixel))
    step = max(_CHUNK // per_pixel, 1)

    def gathered(pose: Float[np.ndarray, "4 4"], directions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        light, _, hits = _look(world, pose, directions, spacing, indirect)
        met[hits.triangle[hits.found]] = True
        return light

    for start in range(0, pixels, step):
        samples = sensor.samples[start : start + step]
        if during:
            parts = [gathered(pose, samples[:, number % per_pixel]) for number, pose in enumerate(during)]
            radiance[start : start + step] = np.mean(parts, axis=0)
        else:
            light = gathered(camera_to_world, samples.reshape(-1, 3))
            radiance[start : start + step] = light.reshape(-1, per_pixel, 3).mean(axis=1)
    hits = world.tracer.cast(camera_to_world, sensor.centers)
    met[hits.triangle[hits.found]] = True
    z_depth = np.where(hits.found, hits.z_depth, np.float32(0.0))
    cover = np.zeros(pixels, np.uint8)
    if world.bodies:
        cover = _look(world, camera_to_world, sensor.centers, spacing, None)[1]
    return Exposure(radiance, z_depth, np.flatnonzero(met), hits, cover)


def meter(
    world: World, sensor: Sensor, camera_to_world: Float[np.ndarray, "4 4"], indirect: IndirectLight | None
) -> Float[np.ndarray, "P 3"]:
    """Radiance of the pixels' centres only, for exposure metering."""
    return _look(world, camera_to_world, sensor.centers, float(np.sqrt(_pixel_solid_angle(sensor))), indirect)[0]


def _look(
    world: World,
    camera_to_world: Float[np.ndarray, "4 4"],
    directions: Float[np.ndarray, "N 3"],
    spacing: float,
    indirect: IndirectLight | None,
) -> tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N"], Hits]:
    """Radiance along rays in camera axes with z = 1, from the wall and from bodies over it; covers; hits on the wall.

    ``spacing`` is the distance between neighbouring samples at z-depth 1.
    """
    hits = world.tracer.cast(camera_to_world, directions)
    light = np.zeros((len(directions), 3), np.float32)
    found = hits.found
    light[found] = _shade(world, camera_to_world, directions[found], hits.only(found), spacing, indirect)
    cover = np.zeros(len(directions), np.uint8)
    z_depth = hits.z_depth.copy()
    for body in world.bodies:
        drawn = body.draw(world.lamps, world.vignetting, camera_to_world, directions, z_depth, light)
        cover[drawn] = body.cover
    return light, cover, hits


def _shade(
    world: World,
    camera_to_world: Float[np.ndarray, "4 4"],
    directions: Float[np.ndarray, "N 3"],
    hits: Hits,
    spacing: float,
    indirect: IndirectLight | None,
) -> Float[np.ndarray, "N 3"]:
    """Radiance reflected from ray hits, all valid, towards the camera.

    ``cos^k theta (albedo (E n.l + E_indirect) + gloss E)`` with ``E = beam (20 / d)^2``, summed over lamps.
    """
    length = np.sqrt(np.einsum("nc,nc->n", directions, directions))
    cos_theta = 1.0 / length
    to_eye = rotated(directions, camera_to_world[:3, :3]) * -cos_theta[:, None]
    points = camera_to_world[:3, 3].astype(np.float32) - to_eye * (hits.z_depth * length)[:, None]

    normals = _unit(world.tracer.interpolate(world.surface.normals, hits))
    slant = np.maximum(np.einsum("nc,nc->n", normals, to_eye), 0.15)
    row, column = world.surface.grid_coordinates(hits.triangle, hits.barycentric)
    # A sample's footprint is an ellipse, elongated on slanted walls; the texture is blurred isotropically.
    material = world.mucosa.sample(row, column, hits.z_depth * spacing / np.sqrt(slant))

    along = world.surface.tangents[world.surface.triangles[hits.triangle, 0]]
    along = _unit(along - normals * np.einsum("nc,nc->n", along, normals)[:, None])
    across = np.cross(normals, along)
    tipped = along * material.slopes[:, :1] + across * material.slopes[:, 1:]
    film = _unit(normals - tipped)
    # Light diffuses about half a millimetre inside tissue, which smooths half of the finest relief's shading.
    tissue = _unit(normals - 0.5 * tipped)

    diffuse, gloss = np.zeros_like(slant), np.zeros_like(slant)
    for lamp in world.lamps:
        strength, to_lamp = lamp.irradiance(points, camera_to_world)
        if lamp.casts_shadows:
            strength *= world.tracer.visible(points, lamp.position(camera_to_world))
        diffuse += strength * lamp.diffuse(tissue, to_lamp, to_eye)
        # The mucus film does not reflect where the wall faces away from the light.
        lit = np.einsum("nc,nc->n", normals, to_lamp) > 0.0
        gloss += lit * (strength * material.wetness * lamp.gloss(film, to_lamp, to_eye, material.slope_variance))
    received = diffuse[:, None]
    if indirect is not None:
        received = received + indirect.at(row, column)
    light = material.albedo * received + gloss[:, None]
    return np.asarray(light * (cos_theta**world.vignetting)[:, None], dtype=np.float32)


def _pixel_solid_angle(sensor: Sensor) -> float:
    """Mean area of a pixel at z-depth 1, near the middle of the image."""
    # The pixel whose top left corner is the middle, and its neighbours.
    middle = np.array([0.5 * sensor.lens.width, 0.5 * sensor.lens.height]) + 0.5
    corner = sensor.lens.unproject(middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(np.linalg.norm(np.cross(corner[1] - corner[0], corner[2] - corner[0])))


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    length = np.sqrt(np.einsum("nc,nc->n", vectors, vectors))
    return np.asarray(vectors / np.maximum(length, 1e-12)[:, None])
