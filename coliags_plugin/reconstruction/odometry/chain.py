"""Frame-to-frame odometry with recovery from lost frames, before pose-graph optimisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coliags_plugin.core.progress import Progress, with_progress
from coliags_plugin.geometry.poses.rigid import inverse, rigid
from coliags_plugin.reconstruction.odometry.registration import Edge

#: (source, target, guess) -> a verified edge, or None.
Register = Callable[[int, int, Float[np.ndarray, "4 4"]], Edge | None]


@dataclass(frozen=True, eq=False)
class Bridge:
    """Constant-velocity guess in place of an edge between two frames, where tracking was lost."""

    source: int
    target: int
    source_to_target: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class Chain:
    """Trajectory from frame-to-frame odometry."""

    posed: tuple[int, ...]  # frames that have a pose by an edge or a bridge, in order; the others are lost
    camera_to_world: Float[np.ndarray, "P 4 4"]  # their poses; world: the first of them
    edges: tuple[Edge, ...]  # between consecutive posed frames
    bridges: tuple[Bridge, ...]  # guesses where there is no edge
    failed: tuple[tuple[int, int], ...]  # consecutive frames (i, i + 1) that could not be registered


def chain(count: int, register: Register, max_gap: int, progress: Progress | None = None) -> Chain:
    """Register every frame to the last posed one.

    A frame for which this fails is registered to its predecessor instead, in case the camera has jumped; then a new
    segment starts at the pose that constant velocity predicts. Frames that match neither are skipped. After
    ``max_gap`` skipped frames the next one gets its constant-velocity pose, and tracking restarts there.
    """
    poses = {0: np.eye(4)}
    anchor, velocity = 0, np.eye(4)
    edges: list[Edge] = []
    bridges: list[Bridge] = []
    failed: list[tuple[int, int]] = []
    for frame in with_progress(range(1, count), "track frames", progress):
        edge = register(frame, anchor, power(velocity, frame - anchor))
        if edge is None:
            failed.append((frame - 1, frame))
            # If the predecessor was skipped, the camera may have jumped: try to register to it.
            fresh = register(frame, frame - 1, velocity) if frame - 1 > anchor else None
            start = frame - 1 if fresh is not None else frame
            if fresh is not None or frame - anchor > max_gap:
                jump = power(velocity, start - anchor)
                bridges.append(Bridge(start, anchor, jump))
                poses[start] = poses[anchor] @ jump
                anchor, edge = start, fresh
                if fresh is not None:
                    failed.pop()
        if edge is not None:
            edges.append(edge)
            poses[frame] = poses[anchor] @ edge.source_to_target
            velocity = power(edge.source_to_target, 1.0 / (frame - anchor))
            anchor = frame
    posed = tuple(sorted(poses))
    return Chain(posed, np.stack([poses[frame] for frame in posed]), tuple(edges), tuple(bridges), tuple(failed))


def fill_gaps(
    posed: tuple[int, ...], camera_to_world: Float[np.ndarray, "P 4 4"], count: int
) -> Float[np.ndarray, "N 4 4"]:
    """Poses of all frames, lost ones interpolated or extrapolated at constant velocity; the first posed frame is 0."""
    result = np.tile(np.eye(4), (count, 1, 1))
    result[list(posed)] = camera_to_world
    velocity = np.eye(4)
    for before, after in pairwise(posed):
        motion = inverse(result[before][None])[0] @ result[after]
        velocity = power(motion, 1.0 / (after - before))
        for frame in range(before + 1, after):
            result[frame] = result[before] @ power(velocity, frame - before)
    for frame in range(posed[-1] + 1, count):
        result[frame] = result[frame - 1] @ velocity
    return result


def power(motion: Float[np.ndarray, "4 4"], exponent: float) -> Float[np.ndarray, "4 4"]:
    """Real power of a rigid transform, along its screw axis: the exponential of its scaled logarithm."""
    if exponent == 1.0:
        return motion
    rotvec = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    velocity = np.linalg.solve(_left_jacobian(rotvec), motion[:3, 3])
    translation = _left_jacobian(exponent * rotvec) @ (exponent * velocity)
    return rigid(Rotation.from_rotvec(exponent * rotvec).as_matrix()[None], translation[None])[0]


def _left_jacobian(rotvec: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Left Jacobian of SO(3) at a rotation vector."""
    angle = float(np.linalg.norm(rotvec))
    x, y, z = rotvec
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sinc is exact near 0; (1 - cos a) / a^2 = sinc(a / 2)^2 / 2.
    first = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    second = (1.0 - np.sinc(angle / np.pi)) / angle**2 if angle > 1e-4 else 1.0 / 6.0
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)
