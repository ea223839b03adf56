"""Ray-traced rendering of the mesh through a lens, and the camera that makes 8-bit images of the radiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.phantom.colon import ColonSurface, Hits, rotated
from coliags_plugin.phantom.light import CameraLight, IndirectLight
from coliags_plugin.phantom.mucosa import Mucosa
from coliags_plugin.phantom.props import Body
from coliags_plugin.phantom.settings import SAME_COLORS, PhantomSettings
from coliags_plugin.phantom.streams import Purpose, slow_drift, smoothstep, stream

#: Samples shaded per batch, which bounds memory and fits the cache.
_CHUNK = 1 << 15


@dataclass(frozen=True)
class Sensor:
    """The lit pixels and their ray directions."""

    lens: Lens
    mask: Bool[np.ndarray, "H W"]  # lit pixels
    centers: Float[np.ndarray, "P 3"]  # ray direction through each lit pixel's centre
    samples: Float[np.ndarray, "P K 3"]  # directions of its K colour samples

    @cached_property
    def pixel_angle(self) -> float:
        """Mean area of a pixel at z-depth 1, near the middle of the image."""
        # The pixel whose top left corner is the middle, and its neighbours.
        middle = np.array([0.5 * self.lens.width, 0.5 * self.lens.height]) + 0.5
        corner = self.lens.unproject(middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return float(np.linalg.norm(np.cross(corner[1] - corner[0], corner[2] - corner[0])))

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
    lamps: tuple[CameraLight, ...]
    vignetting: float
    indirect: IndirectLight | None = None  # for one camera pose
    bodies: tuple[Body, ...] = ()  # over the wall, farther ones first

    def look(
        self, camera_to_world: Float[np.ndarray, "4 4"], directions: Float[np.ndarray, "N 3"], spacing: float
    ) -> tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N"], Hits]:
        """Radiance along rays in camera axes with z = 1, from wall and bodies; covers; hits on the wall.

        ``spacing`` is the distance between neighbouring samples at z-depth 1.
        """
        hits = self.surface.tracer.cast(camera_to_world, directions)
        light = np.zeros((len(directions), 3), np.float32)
        found = hits.found
        light[found] = self._shade(camera_to_world, directions[found], hits.only(found), spacing)
        cover = np.zeros(len(directions), np.uint8)
        z_depth = hits.z_depth.copy()
        for body in self.bodies:
            drawn = body.draw(self.lamps, self.vignetting, camera_to_world, directions, z_depth, light)
            cover[drawn] = body.cover
        return light, cover, hits

    def _shade(
        self,
        camera_to_world: Float[np.ndarray, "4 4"],
        directions: Float[np.ndarray, "N 3"],
        hits: Hits,
        spacing: float,
    ) -> Float[np.ndarray, "N 3"]:
        """Radiance reflected from ray hits, all valid, towards the camera.

        ``cos^k theta (albedo (E n.l + E_indirect) + gloss E)`` with ``E = beam (20 / d)^2``, summed over lamps.
        """
        length = np.sqrt(np.einsum("nc,nc->n", directions, directions))
        cos_theta = 1.0 / length
        to_eye = rotated(directions, camera_to_world[:3, :3]) * -cos_theta[:, None]
        points = camera_to_world[:3, 3].astype(np.float32) - to_eye * (hits.z_depth * length)[:, None]

        normals = _unit(self.surface.tracer.interpolate(self.surface.normals, hits))
        slant = np.maximum(np.einsum("nc,nc->n", normals, to_eye), 0.15)
        row, column = self.surface.grid_coordinates(hits.triangle, hits.barycentric)
        # A sample's footprint is an ellipse, elongated on slanted walls; the texture is blurred isotropically.
        material = self.mucosa.sample(row, column, hits.z_depth * spacing / np.sqrt(slant))

        along = self.surface.tangents[self.surface.triangles[hits.triangle, 0]]
        along = _unit(along - normals * np.einsum("nc,nc->n", along, normals)[:, None])
        across = np.cross(normals, along)
        tipped = along * material.slopes[:, :1] + across * material.slopes[:, 1:]
        film = _unit(normals - tipped)
        # Light diffuses about half a millimetre inside tissue, which smooths half of the finest relief's shading.
        tissue = _unit(normals - 0.5 * tipped)

        diffuse, gloss = np.zeros_like(slant), np.zeros_like(slant)
        for lamp in self.lamps:
            strength, to_lamp = lamp.irradiance(points, camera_to_world)
            if lamp.casts_shadows:
                strength *= self.surface.tracer.visible(points, lamp.position(camera_to_world))
            diffuse += strength * lamp.diffuse(tissue, to_lamp, to_eye)
            # The mucus film does not reflect where the wall faces away from the light.
            lit = np.einsum("nc,nc->n", normals, to_lamp) > 0.0
            gloss += lit * (strength * material.wetness * lamp.gloss(film, to_lamp, to_eye, material.slope_variance))
        received = diffuse[:, None]
        if self.indirect is not None:
            received = received + self.indirect.at(row, column)
        light = material.albedo * received + gloss[:, None]
        return np.asarray(light * (cos_theta**self.vignetting)[:, None], dtype=np.float32)


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
    during: Sequence[Float[np.ndarray, "4 4"]] = (),
) -> Exposure:
    """Render one image. Colour is the mean of a pixel's samples; z-depth and cover are those of its centre.

    With poses ``during`` the exposure, it is the mean over these, of one sample of a pixel each in turn.
    """
    pixels, per_pixel = sensor.samples.shape[:2]
    radiance = np.empty((pixels, 3), np.float32)
    met = np.zeros(len(world.surface.triangles), bool)
    # Distance between neighbouring samples per mm of depth.
    spacing = float(np.sqrt(sensor.pixel_angle / per_pixel))
    step = max(_CHUNK // per_pixel, 1)

    def gathered(pose: Float[np.ndarray, "4 4"], directions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        light, _, hits = world.look(pose, directions, spacing)
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
    hits = world.surface.tracer.cast(camera_to_world, sensor.centers)
    met[hits.triangle[hits.found]] = True
    z_depth = np.where(hits.found, hits.z_depth, np.float32(0.0))
    cover = np.zeros(pixels, np.uint8)
    if world.bodies:
        cover = world.look(camera_to_world, sensor.centers, spacing)[1]
    return Exposure(radiance, z_depth, np.flatnonzero(met), hits, cover)


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    length = np.sqrt(np.einsum("nc,nc->n", vectors, vectors))
    return np.asarray(vectors / np.maximum(length, 1e-12)[:, None])


#: Linear level above which the soft shoulder approaches 1.
KNEE = 0.7
#: Encoded level, 230 of 255, that metering of peaks aims at, and the share of the samples beyond it, %.
_PEAK, _IGNORED = 0.9, 2.0
#: Standard deviation of the weights of metering at the centre, as a share of the image's width.
_CENTRE = 0.18


def exposure_for(
    radiance: Float[np.ndarray, "N 3"], settings: PhantomSettings, weights: Float[np.ndarray, "N"] | None = None
) -> float:
    """The gain, within a factor 1e6 of 1, at which the meter reads what it aims at; 1 for a black image.

    The meter reads the encoded samples: their mean, with ``weights`` if given, or the level of the brightest channel
    that all but the brightest 2 % of the samples stay below.
    """
    if not np.any(radiance > 0.0):
        return 1.0
    peak = settings.metering == "peak"
    target = _PEAK if peak else settings.target_grey
    low, high = np.log(1e-6), np.log(1e6)
    for _ in range(50):
        middle = 0.5 * (low + high)
        value = encoded(radiance * np.exp(middle), settings)
        if peak:
            reading = np.percentile(value.max(axis=1), 100.0 - _IGNORED)
        else:
            reading = value.mean() if weights is None else np.average(value.mean(axis=1), weights=weights)
        if float(reading) < target:
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))


def meter_weights(mask: Bool[np.ndarray, "H W"], settings: PhantomSettings) -> Float[np.ndarray, "N"] | None:
    """Weights of the pixels in a mask for the exposure meter; None if they are equal."""
    if settings.metering != "centre":
        return None
    height, width = mask.shape
    row, column = np.nonzero(mask)
    square = (row + 0.5 - 0.5 * height) ** 2 + (column + 0.5 - 0.5 * width) ** 2
    return np.asarray(np.exp(-0.5 * square / (_CENTRE * width) ** 2))


def encoded(linear: Float[np.ndarray, "N 3"], settings: PhantomSettings) -> Float[np.ndarray, "N 3"]:
    """The camera's response: colour matrix, shoulder, gamma and S-curve; from linear light to values in [0, 1)."""
    if settings.color_matrix != SAME_COLORS:
        linear = linear @ np.asarray(settings.color_matrix, linear.dtype).T
    linear = np.maximum(linear, 0.0)
    room = 1.0 - KNEE
    bent = np.where(linear > KNEE, 1.0 - room * np.exp(np.minimum(KNEE - linear, 0.0) / room), linear)
    value = np.asarray(bent ** (1.0 / settings.gamma))
    if settings.s_curve:
        value += settings.s_curve * (smoothstep(value) - value)
    return value


def exposures(
    ideal: Sequence[float], settings: PhantomSettings, settled: Sequence[float] | None = None
) -> Float[np.ndarray, "T"]:
    """Exposure gain of every frame, from the gain that would bring it to what the meter aims at.

    Automatic exposure follows the logarithm of the ideal gain with a first-order lag, limited to ``gain_span`` around
    the sequence's median, in steps if there are any; fixed exposure is the median. With ``settled``, ideal gains of
    other views, the gains are those at which the exposure of these settles.
    """
    reference = float(np.median(np.log(np.asarray(ideal, np.float64))))
    levels = np.log(np.asarray(ideal if settled is None else settled, np.float64))
    if settings.gain == "fixed":
        return np.full(len(levels), np.exp(reference))
    half_span = 0.5 * np.log(settings.gain_span)
    followed = np.clip(levels, reference - half_span, reference + half_span)
    if settled is None:
        share = 1.0 if settings.gain_lag == 0.0 else 1.0 - np.exp(-1.0 / settings.gain_lag)
        state = followed[0]
        for frame, level in enumerate(followed):
            state += share * (level - state)
            followed[frame] = state
    if settings.gain_steps:
        step = settings.gain_steps * np.log(2.0)
        followed = reference + step * np.rint((followed - reference) / step)
    return np.exp(followed)


def white_balances(settings: PhantomSettings) -> Float[np.ndarray, "T 3"]:
    """Smooth gains of red and blue against green, of log standard deviation ``white_balance_drift``."""
    generator = stream(settings.seed, Purpose.WHITE_BALANCE)
    drift = slow_drift(generator, settings.frames, 2, settings.white_balance_drift or 0.0)
    return np.exp(np.stack([drift[:, 0], np.zeros(settings.frames), drift[:, 1]], axis=1))


def develop(
    radiance: Float[np.ndarray, "P 3"],
    gain: Float[np.ndarray, "3"],
    settings: PhantomSettings,
    generator: np.random.Generator,
    sensor: Sensor,
) -> UInt8[np.ndarray, "P 3"]:
    """The 8-bit image of linear radiance: gain (exposure times white balance), response, noise, and video processor.

    Noise is added to the encoded value; half its variance at mid grey is read noise, the other half is shot noise,
    whose variance grows with the value. The processor sharpens, by an unsharp mask, and compresses.
    """
    value = encoded(radiance * gain.astype(np.float32), settings)
    deviation = settings.noise / 255.0 * np.sqrt(0.5 + value)
    value = value + deviation * generator.standard_normal(value.shape, dtype=np.float32)
    if settings.sharpening:
        value += settings.sharpening * (value - sensor.softened(value, settings.sharpening_radius))
    image = np.clip(np.rint(value * 255.0), 0.0, 255.0).astype(np.uint8)
    if settings.compression is None:
        return image
    _, jpeg = cv2.imencode(".jpg", sensor.image(image)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, settings.compression])
    return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8)[..., ::-1][sensor.mask]
