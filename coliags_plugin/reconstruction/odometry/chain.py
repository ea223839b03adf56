"""From frame to frame: the path before it is corrected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coliags_plugin.core.progress import Progress
from coliags_plugin.poses.rigid import inverse, rigid
from coliags_plugin.reconstruction.odometry.registration import Edge

#: (source, target, guess) -> an edge to believe, or None.
Register = Callable[[int, int, Float[np.ndarray, "4 4"]], Edge | None]


@dataclass(frozen=True, eq=False)
class Bridge:
    """A guess in place of an edge, where tracking was lost for good.

    Attributes:
        source, target: Frames between which nothing was found.
        source_to_target: Constant velocity's guess. [4, 4]
    """

    source: int
    target: int
    source_to_target: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class Chain:
    """A path found from frame to frame.

    Attributes:
        placed: Frames that an edge or a bridge gives a pose, in order; the others are lost.
        camera_to_world: Their poses; world: the first of them. [P, 4, 4]
        edges: Between neighbours among them.
        bridges: Where there is no edge.
        failed: Neighbouring frames (i, i + 1) that could not be laid together.
    """

    placed: tuple[int, ...]
    camera_to_world: Float[np.ndarray, "P 4 4"]
    edges: tuple[Edge, ...]
    bridges: tuple[Bridge, ...]
    failed: tuple[tuple[int, int], ...]


def chain(count: int, register: Register, max_gap: int, progress: Progress | None = None) -> Chain:
    """Lay every frame to the last one whose place is known.

    A frame that cannot be laid there is tried against its predecessor, in case the camera has jumped: then a new
    stretch begins, where constant velocity puts it. Frames that fit neither are passed over. After ``max_gap`` of them
    constant velocity puts the next frame in place, for tracking to begin anew there.

    Args:
        count: Number of frames.
        register: Lays a source to a target frame.
        max_gap: Frames that may be passed over in a row.
        progress: Told how far it is.
    """
    poses = {0: np.eye(4)}
    anchor, velocity = 0, np.eye(4)
    edges: list[Edge] = []
    bridges: list[Bridge] = []
    failed: list[tuple[int, int]] = []
    for frame in range(1, count):
        edge = register(frame, anchor, power(velocity, frame - anchor))
        if edge is None:
            failed.append((frame - 1, frame))
            # Its predecessor was passed over: is it the past that is missing, rather than this frame?
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
        if progress is not None:
            progress("track frames", frame, count - 1)
    placed = tuple(sorted(poses))
    return Chain(placed, np.stack([poses[frame] for frame in placed]), tuple(edges), tuple(bridges), tuple(failed))


def filled(
    placed: tuple[int, ...], camera_to_world: Float[np.ndarray, "P 4 4"], count: int
) -> Float[np.ndarray, "N 4 4"]:
    """Poses of all frames: lost ones at constant velocity between their neighbours, or on from the last two. [N, 4, 4]

    Args:
        placed: Frames with a pose, in order; the first is 0.
        camera_to_world: Their poses. [P, 4, 4]
        count: Number of frames.
    """
    result = np.tile(np.eye(4), (count, 1, 1))
    result[list(placed)] = camera_to_world
    velocity = np.eye(4)
    for before, after in pairwise(placed):
        motion = inverse(result[before][None])[0] @ result[after]
        velocity = power(motion, 1.0 / (after - before))
        for frame in range(before + 1, after):
            result[frame] = result[before] @ power(velocity, frame - before)
    for frame in range(placed[-1] + 1, count):
        result[frame] = result[frame - 1] @ velocity
    return result


def power(motion: Float[np.ndarray, "4 4"], exponent: float) -> Float[np.ndarray, "4 4"]:
    """A rigid motion done so many times, or in part: along its screw. [4, 4]"""
    if exponent == 1.0:
        return motion
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    along = np.linalg.solve(_shift_of_turn(turn), motion[:3, 3])
    shift = _shift_of_turn(exponent * turn) @ (exponent * along)
    return rigid(Rotation.from_rotvec(exponent * turn).as_matrix()[None], shift[None])[0]


def _shift_of_turn(turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """What a steady velocity in turning axes adds up to, turning by a rotation vector: the integral of the rotation."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sinc is exact near 0; (1 - cos a) / a^2 = sinc(a / 2)^2 / 2.
    first = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    second = (1.0 - np.sinc(angle / np.pi)) / angle**2 if angle > 1e-4 else 1.0 / 6.0
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)
