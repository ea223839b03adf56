"""Camera response from radiance to 8-bit images: exposure, white balance, tone curve, noise and video processor."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.phantom.imaging import Sensor
from coliags_plugin.phantom.settings import SAME_COLORS, PhantomSettings
from coliags_plugin.phantom.streams import Purpose, slow_drift, smoothstep, stream

#: Linear level above which the soft shoulder approaches 1.
KNEE = 0.7
#: Encoded level, 230 of 255, that metering of peaks aims at, and the share of the samples beyond it, %.
_PEAK, _IGNORED = 0.9, 2.0
#: Standard deviation of the weights of metering at the centre, as a share of the image's width.
_CENTRE = 0.18


def encode(linear: Float[np.ndarray, "..."], gamma: float, knee: float = KNEE) -> Float[np.ndarray, "..."]:
    """Linear light to pixel values in [0, 1): a power law with a soft shoulder above the linear level ``knee``."""
    linear = np.maximum(linear, 0.0)
    room = 1.0 - knee
    bent = np.where(linear > knee, 1.0 - room * np.exp(np.minimum(knee - linear, 0.0) / room), linear)
    return np.asarray(bent ** (1.0 / gamma))


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
    value = encode(linear, settings.gamma)
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
