"""Rotation between the worlds of two trajectories, from positions where they determine it, else from orientations.

R. Hartley et al., "Rotation averaging", International Journal of Computer Vision 103, 2013: the chordal mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coliags_plugin.geometry.poses.similarity import Similarity

#: Spread of a path (:attr:`Similarity.spread`) below which it is nearly straight: the rotation about it is taken from
#: orientations, as errors of positions are a large part of what little they deviate from a line.
NEARLY_STRAIGHT = 0.1

By = Literal["positions", "orientations about the path", "orientations"]


@dataclass(frozen=True, eq=False)
class WorldRotation:
    """Rotation from the estimate's world to the reference's, with which rotation errors are computed.

    Attributes:
        rotation: Rotation matrix, det 1. [3, 3]
        by: What determined it. ``positions``: those alone. ``orientations about the path``: positions determined the
            direction of the path, the cameras' orientations the rotation about it. ``orientations``: those alone.
        reason: Why positions alone did not, or an empty string.
    """

    rotation: Float[np.ndarray, "3 3"]
    by: By
    reason: str = ""


def world_rotation(
    estimated: Float[np.ndarray, "N 3 3"], true: Float[np.ndarray, "N 3 3"], transform: Similarity
) -> WorldRotation:
    """The rotation between two worlds.

    The rotation of ``transform``, from positions, if the path is not nearly straight; else that rotation, turned about
    the path by the angle that minimises the chordal distances of the orientations; and without any path the chordal
    mean of the relative orientations.

    Args:
        estimated: Camera-to-world rotations. [N, 3, 3]
        true: Those of the same cameras in the other world. [N, 3, 3]
        transform: Least-squares transform of the positions.
    """
    total = np.einsum("nij,nkj->ik", true, estimated)
    if not transform.axis.any():
        return WorldRotation(_nearest_rotation(total), "orientations", transform.undetermined)
    if transform.spread >= NEARLY_STRAIGHT:
        return WorldRotation(transform.rotation, "positions")
    # tr(R(angle)^T M) = constant + cos(angle) (tr M - a^T M a) + sin(angle) a . w, with w the antisymmetric part of M.
    rest, axis = total @ transform.rotation.T, transform.axis
    antisymmetric = np.array([rest[2, 1] - rest[1, 2], rest[0, 2] - rest[2, 0], rest[1, 0] - rest[0, 1]])
    angle = np.arctan2(axis @ antisymmetric, np.trace(rest) - axis @ rest @ axis)
    about = Rotation.from_rotvec(angle * axis).as_matrix()
    reason = transform.undetermined or (
        f"the path is nearly straight: its extent across is {100.0 * transform.spread:.2g} % of that along it"
    )
    return WorldRotation(about @ transform.rotation, "orientations about the path", reason)


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation with the largest tr(R^T M)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)
