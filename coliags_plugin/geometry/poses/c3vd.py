"""C3VD's pose files: camera-to-world matrices, row-major or column-major depending on the release."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.geometry.poses.formats import Format, count_first_numbers, read_numbers
from coliags_plugin.geometry.poses.trajectory import RIGID_TOLERANCE, Trajectory, check_rigid


@dataclass(frozen=True)
class C3vdPoses:
    """The poses of one file."""

    camera_to_world: Float[np.ndarray, "N 4 4"]  # rigid, OpenCV axes, mm
    convention: str  # ``column-major`` (the current release) or ``row-major`` (the one under review)
    evidence: dict[str, Any]  # measurements behind that choice, and a summary of the trajectory


def read_poses(path: Path) -> C3vdPoses:
    """Read ``pose.txt`` or ``camera_pose.txt``: sixteen numbers per line, separated by commas or blanks.

    The web page calls the files row-major, but they are column-major (docs/layouts/c3vd.md 4). So the order is
    detected: read row-major, a rigid transform has its translation in the last column and (0, 0, 0, 1) in the last row.
    """
    lines = read_numbers(
        path,
        16,
        "16 finite numbers, a camera-to-world transform",
        "Restore the file from the data set, or remove that frame and its line together",
    )
    matrices = np.array([numbers for _, numbers in lines]).reshape(-1, 4, 4)
    last_column = np.abs(matrices[:, :3, 3]).max(initial=0.0)
    last_row = np.abs(matrices[:, 3, :3]).max(initial=0.0)
    by_columns = matrices.transpose(0, 2, 1)
    # By majority of the lines, so that one damaged line is reported and does not change the order.
    is_row = np.abs(matrices[:, 3, :3]).max(axis=1) < 1e-6
    is_column = np.abs(matrices[:, :3, 3]).max(axis=1) < 1e-6
    if np.all(is_row & is_column) and not np.allclose(matrices, by_columns, atol=1e-6):
        raise InputError(
            f"{path}: no pose has a translation, so that row-major and column-major order cannot be distinguished",
            "at least one camera away from the world's origin",
            "Check that the file holds camera-to-world transforms in mm",
        )
    column_major = is_column.sum() >= is_row.sum()
    camera_to_world = by_columns if column_major else matrices
    check_rigid(
        camera_to_world,
        lambda index: f"{path}, line {lines[index][0]}",
        f"both within {RIGID_TOLERANCE:g}, the translation of every line in the same place",
        "Restore the file from the data set",
    )
    rotations, centers = camera_to_world[:, :3, :3], camera_to_world[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return C3vdPoses(
        camera_to_world,
        "column-major" if column_major else "row-major",
        {
            "largest_number_in_last_row": float(last_row),
            "largest_number_in_last_column": float(last_column),
            "largest_rotation_error": float(np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max()),
            "trajectory_length_mm": float(steps.sum()),
            "mean_step_mm": float(steps.mean()) if len(steps) else 0.0,
            "mean_viewing_direction": [float(value) for value in rotations[:, :, 2].mean(axis=0)],
        },
    )


def read(path: Path) -> Trajectory:
    """Read a C3VD pose file, row-major or column-major."""
    poses = read_poses(path)
    return Trajectory(poses.camera_to_world, stored_as=f"camera-to-world matrices, {poses.convention}")


def write(path: Path, trajectory: Trajectory) -> None:
    """Write column-major matrices of the current release, sixteen unrounded numbers per line."""
    atomic_write(path, matrix_lines(trajectory.camera_to_world))


def matrix_lines(camera_to_world: Float[np.ndarray, "N 4 4"], digits: int | None = None) -> str:
    """Text of a pose file: sixteen numbers per line, column-major; ``digits`` significant digits, None for all."""
    columns = np.asarray(camera_to_world, np.float64).transpose(0, 2, 1).reshape(-1, 16).tolist()
    lines = [
        ",".join(repr(number) if digits is None else f"{number:.{digits}g}" for number in line) for line in columns
    ]
    return "\n".join(lines) + "\n"


FORMAT = Format("c3vd", read, write, lambda path: count_first_numbers(path) == 16, unit="mm")
