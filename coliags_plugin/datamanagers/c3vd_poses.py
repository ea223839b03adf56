"""C3VD's pose files: camera-to-world matrices whose reading order changed between releases."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.errors import InputError

#: How far R^T R may be from the identity. The files carry six digits, which is 1e-6 off.
RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Poses:
    """The poses of one file.

    Attributes:
        camera_to_world: Rigid, OpenCV axes, mm. [N, 4, 4]
        convention: ``column-major`` (the current release) or ``row-major`` (the one under review).
        evidence: The figures behind that choice, and what the trajectory then looks like.
    """

    camera_to_world: Float[np.ndarray, "N 4 4"]
    convention: str
    evidence: dict[str, Any]


def read_poses(path: Path) -> Poses:
    """Read ``pose.txt`` or ``camera_pose.txt``: sixteen numbers a line, separated by commas or blanks.

    The web page calls the files row-major; the numbers are columns (docs/data.md 4). So the order is found, not
    believed: read row by row, a rigid transform has its translation in the last column and (0, 0, 0, 1) in the last
    row.

    Raises:
        InputError: A line does not hold sixteen finite numbers, or is a rigid transform in neither reading, or is
            left-handed; or the order cannot be told.
    """
    lines = _numbers(path)
    matrices = np.array([numbers for _, numbers in lines]).reshape(-1, 4, 4)
    last_column = np.abs(matrices[:, :3, 3]).max(initial=0.0)
    last_row = np.abs(matrices[:, 3, :3]).max(initial=0.0)
    by_columns = matrices.transpose(0, 2, 1)
    # Most lines decide, so that one spoilt line is called spoilt and does not turn the whole file.
    is_row = np.abs(matrices[:, 3, :3]).max(axis=1) < 1e-6
    is_column = np.abs(matrices[:, :3, 3]).max(axis=1) < 1e-6
    if np.all(is_row & is_column) and not np.allclose(matrices, by_columns, atol=1e-6):
        raise InputError(
            f"{path}: no pose has a translation, so rows cannot be told from columns",
            "at least one camera away from the world's origin",
            "Check that the file holds camera-to-world transforms in mm",
        )
    column_major = is_column.sum() >= is_row.sum()
    camera_to_world = by_columns if column_major else matrices
    for (number, _), matrix in zip(lines, camera_to_world, strict=True):
        _check_rigid(matrix, f"{path}, line {number}")
    rotations, centers = camera_to_world[:, :3, :3], camera_to_world[:, :3, 3]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return Poses(
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


def _numbers(path: Path) -> list[tuple[int, list[float]]]:
    lines: list[tuple[int, list[float]]] = []
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}", "a text file of poses") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = [word for word in re.split(r"[,\s]+", line) if word]
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != 16 or not np.all(np.isfinite(values)):
            shown = line.strip() if len(line.strip()) <= 60 else f"{line.strip()[:57]}..."
            raise InputError(
                f"{path}, line {number}: '{shown}'",
                "16 finite numbers, a camera-to-world transform",
                "Restore the file from the data set, or remove that frame and its line together",
            )
        lines.append((number, values))
    if not lines:
        raise InputError(f"{path} holds no poses", "one line of 16 numbers per frame")
    return lines


def _check_rigid(matrix: Float[np.ndarray, "4 4"], place: str) -> None:
    rotation = matrix[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    border = float(np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max())
    if max(error, border) > RIGID_TOLERANCE:
        raise InputError(
            f"{place}: not a rigid transform (R^T R is {error:.2g} from the identity, "
            f"the fixed part {border:.2g} from 0, 0, 0, 1)",
            f"both within {RIGID_TOLERANCE:g}, the translation of every line in the same place",
            "Restore the file from the data set",
        )
    if np.linalg.det(rotation) < 0.0:
        raise InputError(
            f"{place}: a left-handed transform (det R = -1)",
            "camera axes x right, y down, z forward in a right-handed world",
            "Undo the flip of one axis in whatever wrote the file",
        )
