"""Camera response from radiance to 8-bit images: exposure, white balance, tone curve and noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.ndimage
from jaxtyping import Float, UInt8

from coliags_plugin.lighting.tone_curve import encode
from coliags_plugin.phantom.settings import PhantomSettings, value_or_default
from coliags_plugin.phantom.streams import Purpose, stream

#: Correlation length of the white balance's drift, frames.
_DRIFT_LENGTH = 20.0


def exposure_for(radiance: Float[np.ndarray, "N 3"], target: float, gamma: float) -> float:
    """The gain, within a factor 1e6 of 1, that gives the encoded samples mean ``target``; 1 for a black image."""
    if not np.any(radiance > 0.0):
        return 1.0
    low, high = np.log(1e-6), np.log(1e6)
    for _ in range(50):
        middle = 0.5 * (low + high)
        if float(encode(radiance * np.exp(middle), gamma).mean()) < target:
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))


def exposures(ideal: Sequence[float], settings: PhantomSettings) -> Float[np.ndarray, "T"]:
    """Exposure gain of every frame, from the gain that would bring it to the target grey.

    Automatic exposure follows the logarithm of the ideal gain with a first-order lag, limited to ``gain_span`` around
    the sequence's median; fixed exposure is the median.
    """
    wanted = np.log(np.asarray(ideal, np.float64))
    reference = float(np.median(wanted))
    if value_or_default(settings.gain, settings.light_preset.gain) == "fixed":
        return np.full(len(wanted), np.exp(reference))
    half_span = 0.5 * np.log(settings.gain_span)
    wanted = np.clip(wanted, reference - half_span, reference + half_span)
    share = 1.0 if settings.gain_lag == 0.0 else 1.0 - np.exp(-1.0 / settings.gain_lag)
    followed = np.empty_like(wanted)
    state = wanted[0]
    for frame, level in enumerate(wanted):
        state += share * (level - state)
        followed[frame] = state
    return np.exp(followed)


def white_balances(settings: PhantomSettings) -> Float[np.ndarray, "T 3"]:
    """Smooth gains of red and blue against green, of log standard deviation ``white_balance_drift``."""
    generator = stream(settings.seed, Purpose.WHITE_BALANCE)
    drift = generator.standard_normal((settings.frames + 8 * int(_DRIFT_LENGTH), 2))
    drift = scipy.ndimage.gaussian_filter1d(drift, _DRIFT_LENGTH, axis=0)[4 * int(_DRIFT_LENGTH) :][: settings.frames]
    # Scaled by the filter's known gain, not by the sample's deviation, since a short sequence covers only part of it.
    drift *= np.sqrt(2.0 * np.sqrt(np.pi) * _DRIFT_LENGTH) * value_or_default(
        settings.white_balance_drift, settings.light_preset.white_balance_drift
    )
    return np.exp(np.stack([drift[:, 0], np.zeros(settings.frames), drift[:, 1]], axis=1))


def develop(
    radiance: Float[np.ndarray, "N 3"],
    gain: Float[np.ndarray, "3"],
    settings: PhantomSettings,
    generator: np.random.Generator,
) -> UInt8[np.ndarray, "N 3"]:
    """Apply gain (exposure times white balance), tone curve and noise to linear radiance, and quantise to 8 bits.

    Noise is added to the encoded value; half its variance at mid grey is read noise, the other half is shot noise,
    whose variance grows with the value.
    """
    value = encode(radiance * gain.astype(np.float32), settings.gamma)
    deviation = settings.noise / 255.0 * np.sqrt(0.5 + value)
    value = value + deviation * generator.standard_normal(value.shape, dtype=np.float32)
    return np.clip(np.rint(value * 255.0), 0.0, 255.0).astype(np.uint8)
