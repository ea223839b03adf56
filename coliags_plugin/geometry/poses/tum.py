"""Reads and writes TUM trajectory files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coliags_plugin.core.files import atomic_write
from coliags_plugin.geometry.poses.formats import Format, count_first_numbers, read_numbers
from coliags_plugin.geometry.poses.rigid import rigid, rotations_from_wxyz, wxyz_from_rotations
from coliags_plugin.geometry.poses.trajectory import Trajectory


def read(path: Path) -> Trajectory:
    """Read lines of ``timestamp tx ty tz qx qy qz qw``: camera-to-world, seconds, unit quaternion with w last."""
    lines = read_numbers(
        path,
        8,
        "8 finite numbers: timestamp tx ty tz qx qy qz qw",
        "Write one camera-to-world pose per line, comments after #",
        comments=True,
    )
    rows = np.array([numbers for _, numbers in lines])
    quats_wxyz = rows[:, [7, 4, 5, 6]]
    rotations = rotations_from_wxyz(quats_wxyz, lambda index: f"{path}, line {lines[index][0]}", unit=True)
    return Trajectory(
        rigid(rotations, rows[:, 1:4]),
        timestamps=rows[:, 0],
        stored_as="camera-to-world translations and quaternions, w last",
    )


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file; without timestamps, frame indices are written instead."""
    timestamps = trajectory.timestamps if trajectory.timestamps is not None else np.arange(len(trajectory))
    xyzw = wxyz_from_rotations(trajectory.rotations)[:, [1, 2, 3, 0]]
    rows = np.column_stack([timestamps, trajectory.centers, xyzw])
    lines = [" ".join(repr(float(number)) for number in row) for row in rows]
    atomic_write(path, "\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n")


def recognise(path: Path) -> bool:
    """Whether a file's first line, comments apart, holds eight numbers."""
    return count_first_numbers(path) == 8


FORMAT = Format("tum", read, write, recognise, keeps=frozenset({"timestamps"}))
