"""Independent random number streams per purpose from one seed, smooth noise and steps."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import scipy.fft
import scipy.ndimage
from jaxtyping import Float

#: Correlation length of drifts, frames.
_DRIFT_LENGTH = 20.0


class Purpose(IntEnum):
    """Purpose of a stream. Renumbering would change the phantom of a seed."""

    ANATOMY = 0
    RELIEF = 1
    MUCOSA = 2
    TRAJECTORY = 3
    ROTATION_VIEWS = 4
    WHITE_BALANCE = 5
    SENSOR = 6
    INTERREFLECTION = 7
    POINTS = 8
    WALL_MOTION = 9
    PROPS = 10
    POSE_NOISE = 11
    DEPTH_NOISE = 12


def stream(seed: int, purpose: Purpose, *key: int) -> np.random.Generator:
    """The independent generator of a purpose and, through ``key``, for instance of a frame."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(purpose), *key)))


def slow_drift(
    generator: np.random.Generator, frames: int, columns: int, deviation: float | Float[np.ndarray, "K"]
) -> Float[np.ndarray, "T K"]:
    """Independent smooth processes of a standard deviation over frames."""
    margin = 4 * int(_DRIFT_LENGTH)
    drift = generator.standard_normal((frames + 2 * margin, columns))
    drift = scipy.ndimage.gaussian_filter1d(drift, _DRIFT_LENGTH, axis=0)[margin : margin + frames]
    # Scaled by the filter's known gain, not by the sample's deviation, since a short sequence covers only part of it.
    return np.asarray(drift * (np.sqrt(2.0 * np.sqrt(np.pi) * _DRIFT_LENGTH) * deviation))


class SolidNoise:
    """Smooth 3D noise as a function of position, free of seams and texture stretching.

    Its period is 64 times its scale, along random directions.
    """

    _SIZE = 128
    #: Standard deviation of the smoothing kernel in voxels, large enough for linear interpolation.
    _SIGMA = 2.0

    def __init__(self, generator: np.random.Generator) -> None:
        spectrum = scipy.fft.rfftn(generator.standard_normal((self._SIZE,) * 3, dtype=np.float32))
        full, half = np.fft.fftfreq(self._SIZE), np.fft.rfftfreq(self._SIZE)
        for axis, frequency in enumerate((full, full, half)):
            kernel = np.exp(-2.0 * (np.pi * self._SIGMA * frequency) ** 2).astype(np.float32)
            spectrum *= kernel.reshape([-1 if axis == other else 1 for other in range(3)])
        spectrum[0, 0, 0] = 0.0
        volume = scipy.fft.irfftn(spectrum, s=(self._SIZE,) * 3)
        self._volume = np.asarray(volume / volume.std(), dtype=np.float32)
        self._generator = generator

    def layer(self, points: Float[np.ndarray, "... 3"], scale: float) -> Float[np.ndarray, "..."]:
        """Noise of zero mean and unit deviation at points, mm; every call samples an independent layer.

        ``scale`` is the size of its blobs, about 2.5 standard deviations of its kernel, mm.
        """
        turn, _ = np.linalg.qr(self._generator.standard_normal((3, 3)))
        shift = self._generator.uniform(0.0, self._SIZE, 3)
        turn = (turn * (2.5 * self._SIGMA / scale)).astype(np.float32)
        # map_coordinates takes one row per coordinate; as a matrix product this takes eight times as long.
        coordinates = np.einsum("nc,cd->dn", points.reshape(-1, 3), turn) + shift.astype(np.float32)[:, None]
        noise = scipy.ndimage.map_coordinates(self._volume, coordinates, order=1, mode="grid-wrap", output=np.float32)
        return np.asarray(noise.reshape(points.shape[:-1]))


#: Golden angle, radians: multiples of it distribute any number of directions evenly.
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def quintic(x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Perlin's quintic step over [0, 1], whose first and second derivatives are 0 at its ends."""
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))


def smoothstep(x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Cubic Hermite step: 0 below 0, 1 above 1."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))
