"""Reads and writes TUM trajectory files."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coliags_plugin.core.files import atomic_write
from coliags_plugin.geometry.poses.formats import Format, count_first_numbers, head_text, read_numbers
from coliags_plugin.geometry.poses.trajectory import (
    ZERO_QUATERNION,
    Trajectory,
    rigid,
    rotations_from_wxyz,
    wxyz_from_rotations,
)

log = logging.getLogger(__name__)

#: Names of a quaternion's parts in a line that names the columns: ``qx``, ``q_w``.
_PARTS = re.compile(r"\bq\w*?([xyzw])\b", re.IGNORECASE)
#: Steps of a path, and how little of it is straight, that tell the order of quaternions; see :func:`_seem_w_first`.
_LEAST_STEPS, _STRAIGHT, _ALONG_AN_AXIS, _ALONG_NONE = 10, 0.9, 0.95, 0.75


def read(path: Path) -> Trajectory:
    """Read lines of ``timestamp tx ty tz qx qy qz qw``: camera-to-world, seconds, unit quaternion with w last.

    A line before the numbers that names the columns, a comment or not, may put ``qw`` first.
    """
    lines = read_numbers(
        path,
        8,
        "8 finite numbers, with decimal points: timestamp tx ty tz qx qy qz qw",
        "Write one camera-to-world pose per line, comments after #",
        comments=True,
    )
    rows = np.array([numbers for _, numbers in lines])
    names = head_text(path).splitlines()[: lines[0][0] - 1]
    w_first = any("".join(_PARTS.findall(line)).lower() == "wxyz" for line in names)
    if not w_first and _seem_w_first(rows[:, 1:4], rows[:, 4:]):
        log.warning(
            "%s: the quaternions look as if w came first, but TUM's order is qx qy qz qw, and is read; if w is first, "
            "put the line '# timestamp tx ty tz qw qx qy qz' on top of the file",
            path,
        )
    quats_wxyz = rows[:, 4:] if w_first else rows[:, [7, 4, 5, 6]]
    rotations = rotations_from_wxyz(quats_wxyz, lambda index: f"{path}, line {lines[index][0]}", unit=True)
    return Trajectory(
        rigid(rotations, rows[:, 1:4]),
        timestamps=rows[:, 0],
        stored_as="camera-to-world translations and quaternions, w " + ("first" if w_first else "last"),
    )


def _seem_w_first(centers: Float[np.ndarray, "N 3"], quats: Float[np.ndarray, "N 4"]) -> bool:
    """Return True if the path of the camera suggests that stored quaternions have w first.

    Angles between cameras are the same in either order. What tells is a first camera at the origin, ``1 0 0 0``, the
    identity in one order only; or a path with bends along which a camera moves along one axis of its own, forward for
    instance, in one order only. Most paths tell nothing.
    """
    if len(quats) < 3 or (np.linalg.norm(quats, axis=1) < ZERO_QUATERNION).any():
        return False
    if np.abs(centers[0]).max() < 1e-6 and abs(quats[0, 0]) > 1.0 - 1e-6:
        return True
    steps = np.diff(centers, axis=0)
    moves = np.linalg.norm(steps, axis=1) > 0.0
    steps = steps[moves] / np.linalg.norm(steps[moves], axis=1, keepdims=True)

    def along_an_axis(turns: Rotation) -> float:
        """Mean square cosine of the angles of steps and the axis nearest to them, of the camera before each step."""
        local = turns[:-1][moves].inv().apply(steps)
        return float(np.linalg.eigvalsh(local.T @ local / len(local))[-1])

    return (
        len(steps) >= _LEAST_STEPS
        and along_an_axis(Rotation.identity(len(quats))) < _STRAIGHT
        and along_an_axis(Rotation.from_quat(quats)) < _ALONG_NONE
        and along_an_axis(Rotation.from_quat(quats, scalar_first=True)) > _ALONG_AN_AXIS
    )


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file; without timestamps, frame indices are written instead."""
    timestamps = trajectory.timestamps if trajectory.timestamps is not None else np.arange(len(trajectory))
    xyzw = wxyz_from_rotations(trajectory.rotations)[:, [1, 2, 3, 0]]
    rows = np.column_stack([timestamps, trajectory.centers, xyzw])
    lines = [" ".join(repr(float(number)) for number in row) for row in rows]
    atomic_write(path, "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n")


FORMAT = Format("tum", read, write, lambda path: count_first_numbers(path) == 8, keeps=frozenset({"timestamps"}))
