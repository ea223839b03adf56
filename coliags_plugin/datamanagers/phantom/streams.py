"""Random numbers: one independent stream per purpose, all children of one seed."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import scipy.fft
from jaxtyping import Float


class Purpose(IntEnum):
    """What a stream is for. The numbers are part of what a seed means: never renumber them."""

    ANATOMY = 0
    RELIEF = 1
    MUCOSA = 2
    TRAJECTORY = 3
    ROTATION_VIEWS = 4
    WHITE_BALANCE = 5
    SENSOR = 6
    INTERREFLECTION = 7


def stream(seed: int, purpose: Purpose, *key: int) -> np.random.Generator:
    """The generator of one purpose (and of one frame, say, through ``key``), whatever was drawn before elsewhere."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(purpose), *key)))


def smooth_noise(
    shape: tuple[int, int], sigma: tuple[float, float], generator: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """Gaussian noise of unit standard deviation and zero mean with a Gaussian correlation, periodic in both axes.

    Args:
        shape: Rows, columns.
        sigma: Standard deviation of the smoothing kernel along rows and columns, cells.
        generator: Where the white noise comes from.

    Returns:
        Float32. [H, W]
    """
    spectrum = scipy.fft.rfft2(generator.standard_normal(shape, dtype=np.float32))
    rows = np.exp(-2.0 * (np.pi * sigma[0] * np.fft.fftfreq(shape[0])) ** 2).astype(np.float32)
    columns = np.exp(-2.0 * (np.pi * sigma[1] * np.fft.rfftfreq(shape[1])) ** 2).astype(np.float32)
    spectrum *= rows[:, None] * columns[None, :]
    spectrum[0, 0] = 0.0
    noise = scipy.fft.irfft2(spectrum, s=shape)
    return np.asarray(noise / max(float(noise.std()), 1e-12), dtype=np.float32)


def smoothstep(x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """0 below 0, 1 above 1, and a cubic with flat ends between."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))
