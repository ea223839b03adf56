"""Centre line of the colon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coliags_plugin.lighting.beams import smoothstep

#: Length of the segment, mm.
LENGTH = 232.0
#: Arc length at which the strong bend begins and over which it turns, mm. Its tightest radius of curvature, about
#: 26 mm, stays above the lumen's radius, so the wall never folds into itself.
BEND_START, BEND_LENGTH = 112.0, 82.0
BEND_ANGLE = 1.65
_STEP = 0.25


@dataclass(frozen=True)
class CentreLine:
    """A space curve with a rotation-minimising frame."""

    points: Float[np.ndarray, "M 3"]  # world, mm, every 0.25 mm of arc
    frames: Float[np.ndarray, "M 3 3"]  # columns: across, across and tangent; right-handed

    def at(self, arc: Float[np.ndarray, "N"]) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 3"]]:
        """Points and frames at arc lengths, mm."""
        position = np.clip(np.asarray(arc, dtype=np.float64) / _STEP, 0.0, len(self.points) - 1.001)
        low = position.astype(int)
        weight = position - low
        points = self.points[low] * (1.0 - weight)[:, None] + self.points[low + 1] * weight[:, None]
        mixed = self.frames[low] * (1.0 - weight)[:, None, None] + self.frames[low + 1] * weight[:, None, None]
        tangent = mixed[..., 2] / np.linalg.norm(mixed[..., 2], axis=-1, keepdims=True)
        across = mixed[..., 0] - (mixed[..., 0] * tangent).sum(-1, keepdims=True) * tangent
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        return points, np.stack([across, np.cross(tangent, across), tangent], axis=-1)


def grow_centre_line(generator: np.random.Generator) -> CentreLine:
    """Generate a gentle curve with a strong bend at its end, which closes the lumen in the image.

    Starts at the origin, roughly along +z.
    """
    arc = np.arange(0.0, LENGTH + _STEP, _STEP)
    bend = smoothstep((arc - BEND_START) / BEND_LENGTH)
    clock = generator.uniform(0.0, 2.0 * np.pi)
    angles = []
    for direction in (np.cos(clock), np.sin(clock)):
        phase, period, amplitude = generator.uniform([0.0, 150.0, 0.14], [2.0 * np.pi, 210.0, 0.24])
        gentle = amplitude * (np.sin(2.0 * np.pi * arc / period + phase) - np.sin(phase))
        angles.append(gentle * (1.0 - bend) + direction * BEND_ANGLE * bend)
    yaw, pitch = angles
    tangents = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=-1)
    middle = 0.5 * (tangents[1:] + tangents[:-1])
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(middle * _STEP, axis=0)])
    frames = np.empty((len(arc), 3, 3))
    across = np.array([1.0, 0.0, 0.0])
    for index, tangent in enumerate(tangents):
        # Parallel transport: drop what is no longer perpendicular. The frame never spins about the curve.
        across = across - (across @ tangent) * tangent
        across = across / np.linalg.norm(across)
        frames[index] = np.stack([across, np.cross(tangent, across), tangent], axis=-1)
    return CentreLine(points, frames)
