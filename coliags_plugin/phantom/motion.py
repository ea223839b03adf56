"""Parts that the camera paths of phantoms share: clearance, rotations and smooth random motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from coliags_plugin.phantom.settings import PhantomSettings

#: No closer to the wall than this, mm; C3VD's nearest surface of any sequence is 5.9 mm away.
NEAREST = 6.0
#: Arc length of a withdrawal's shallow end, mm. Far enough in that a view turned sideways still ends on the wall.
SHALLOW_END = 26.0

Curve = Callable[[Float[np.ndarray, "T"]], Float[np.ndarray, "T"]]


def times(settings: PhantomSettings) -> Float[np.ndarray, "T"]:
    """Time of every frame along the path, from 0 to 1: even steps, and none during pauses."""
    pauses = settings.pauses
    moving = settings.frames - pauses * settings.pause_frames
    frames = np.ones(moving, dtype=np.int64)
    for pause in range(pauses):
        frames[round((pause + 1) / (pauses + 1) * (moving - 1))] += settings.pause_frames
    return np.repeat(np.linspace(0.0, 1.0, moving), frames)


def rotation(yaw: float, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Rotation right by yaw, then up by pitch, then clockwise by roll; radians, camera axes."""
    return np.asarray(
        rotation_about(np.array([0.0, 1.0, 0.0]), yaw)
        @ rotation_about(np.array([1.0, 0.0, 0.0]), pitch)
        @ rotation_about(np.array([0.0, 0.0, 1.0]), roll)
    )


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about a unit axis, radians, right-handed (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def draw_sway(generator: np.random.Generator) -> Curve:
    """A smooth random curve with amplitude 1 over times from 0 to 1, independent of its sampling."""
    cycles = np.array([0.6, 1.3, 2.4])
    phase = generator.uniform(0.0, 2.0 * np.pi, 3)
    weight = np.array([1.0, 0.7, 0.35]) * generator.uniform(0.7, 1.3, 3)

    def curve(at: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return np.asarray((weight * np.sin(2.0 * np.pi * cycles * at[:, None] + phase)).sum(axis=1))

    largest = np.abs(curve(np.linspace(0.0, 1.0, 512))).max()
    return lambda at: np.asarray(curve(at) / largest)
