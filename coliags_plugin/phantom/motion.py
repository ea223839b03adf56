"""Parts that the camera paths of phantoms share: clearance, rotations and smooth random motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from coliags_plugin.phantom.settings import PhantomSettings

#: No closer to the wall than this, mm; C3VD's nearest surface of any sequence is 5.9 mm away.
NEAREST = 6.0
#: Arc length of a withdrawal's shallow end, mm. Far enough in that a view turned sideways still ends on the wall.
SHALLOW_END = 26.0

#: Cycles of a sway over a sequence.
_CYCLES = np.array([0.6, 1.3, 2.4])

Curve = Callable[[Float[np.ndarray, "T"]], Float[np.ndarray, "T"]]
#: Distance at which the image motion of an exposure is judged, mm, and the motion from one rendering to the next, px.
_JUDGED_AT, _BLUR_STEP = 15.0, 1.25
#: Most renderings of an exposure.
_MOST = 24


def poses_between(poses: Float[np.ndarray, "T 4 4"], at: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 4 4"]:
    """Poses at fractional frames; positions and rotations are linear from frame to frame."""
    at = np.clip(at, 0.0, len(poses) - 1.0)
    numbers = np.arange(len(poses))
    between = np.tile(np.eye(4), (len(at), 1, 1))
    between[:, :3, :3] = Slerp(numbers, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    between[:, :3, 3] = np.stack([np.interp(at, numbers, axis) for axis in poses[:, :3, 3].T], axis=1)
    return between


def poses_during(
    poses: Float[np.ndarray, "T 4 4"], frame: int, shutter: float, focal_length: float, least: int
) -> list[Float[np.ndarray, "4 4"]]:
    """Poses at even times of a frame's exposure, ``least`` or more, close enough for a smooth blur.

    The shutter is open for the share ``shutter`` of the frame interval, and the frame's own pose is in the middle.
    """
    first, last = poses_between(poses, frame + shutter * np.array([-0.5, 0.5]))
    angle = np.arccos(np.clip(0.5 * (np.trace(first[:3, :3].T @ last[:3, :3]) - 1.0), -1.0, 1.0))
    moved = np.linalg.norm(last[:3, 3] - first[:3, 3])
    count = int(np.clip(np.ceil(focal_length * (angle + moved / _JUDGED_AT) / _BLUR_STEP), least, max(_MOST, least)))
    return list(poses_between(poses, frame + shutter * ((np.arange(count) + 0.5) / count - 0.5)))


def times(settings: PhantomSettings) -> Float[np.ndarray, "T"]:
    """Time of every frame along the path, from 0 to 1, in even steps."""
    return np.linspace(0.0, 1.0, settings.frames)


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


def looking(
    centers: Float[np.ndarray, "T 3"], targets: Float[np.ndarray, "T 3"], frames: Float[np.ndarray, "T 3 3"]
) -> Float[np.ndarray, "T 4 4"]:
    """Poses that look at targets, x along the centre line's first across direction."""
    forward = targets - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = frames[:, :, 0] - (frames[:, :, 0] * forward).sum(axis=1, keepdims=True) * forward
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=2)
    poses[:, :3, 3] = centers
    return poses


def draw_sway(generator: np.random.Generator, cycles: Float[np.ndarray, "3"] = _CYCLES) -> Curve:
    """A smooth random curve with amplitude 1 over times from 0 to 1, independent of its sampling."""
    phase = generator.uniform(0.0, 2.0 * np.pi, 3)
    weight = np.array([1.0, 0.7, 0.35]) * generator.uniform(0.7, 1.3, 3)

    def curve(at: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        return np.asarray((weight * np.sin(2.0 * np.pi * cycles * at[:, None] + phase)).sum(axis=1))

    largest = np.abs(curve(np.linspace(0.0, 1.0, 512))).max()
    return lambda at: np.asarray(curve(at) / largest)
