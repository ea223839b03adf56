"""Camera trajectories, independent of the file format."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.geometry.poses.rigid import check_rigid


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses in video order, rigid, with OpenCV axes (x right, y down, z forward).

    Lengths and world are as in the file, unless a remark says otherwise.
    """

    camera_to_world: Float[np.ndarray, "N 4 4"]  # float64
    names: tuple[str, ...] | None = None  # image name of each pose in the file
    timestamps: Float[np.ndarray, "N"] | None = None  # capture time of each image, s. float64
    intrinsics: Intrinsics | None = None  # the pinhole that took all images; None: unknown, or other cameras
    # The camera of each pose, by nerfstudio's keys, where they are not one pinhole and nerfstudio has them
    cameras: tuple[JsonObject, ...] | None = None
    stored_as: str = ""  # convention of the file, for messages
    remarks: tuple[str, ...] = ()  # changes and omissions when the file was read

    def __post_init__(self) -> None:
        """Refuse no poses, those not rigid, right-handed and finite, and other than one name or finite time each."""
        matrices = np.asarray(self.camera_to_world, dtype=np.float64)
        if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or not len(matrices):
            raise InputError(f"poses of the shape {list(matrices.shape)}", "[N, 4, 4], at least one")
        check_rigid(matrices, lambda index: f"pose {index}")
        object.__setattr__(self, "camera_to_world", matrices)
        if self.names is not None and len(self.names) != len(matrices):
            raise InputError(f"{len(self.names)} names for {len(matrices)} poses", "one for each")
        if self.timestamps is not None:
            timestamps = np.asarray(self.timestamps, dtype=np.float64)
            if timestamps.shape != (len(matrices),) or not np.all(np.isfinite(timestamps)):
                raise InputError(
                    f"timestamps of the shape {list(timestamps.shape)} for {len(matrices)} poses",
                    "one finite number for each",
                )
            object.__setattr__(self, "timestamps", timestamps)

    def __len__(self) -> int:
        return len(self.camera_to_world)

    @property
    def centers(self) -> Float[np.ndarray, "N 3"]:
        """Camera centres in the world. [N, 3]"""
        return self.camera_to_world[:, :3, 3]

    @property
    def rotations(self) -> Float[np.ndarray, "N 3 3"]:
        """Camera-to-world rotations. [N, 3, 3]"""
        return self.camera_to_world[:, :3, :3]

    @property
    def steps(self) -> Float[np.ndarray, "N-1"]:
        """Distance of each centre from the one before it. [N - 1]"""
        return np.asarray(np.linalg.norm(np.diff(self.centers, axis=0), axis=1))

    def summary(self, unit: str = "units") -> str:
        """One-line summary: number of poses, path length and viewing direction, which reveal a wrong convention."""
        steps = self.steps
        mean_step = float(steps.mean()) if len(steps) else 0.0
        x, y, z = self.rotations[:, :, 2].mean(axis=0)
        return (
            f"{len(self)} poses, path {steps.sum():.4g} {unit}, mean step {mean_step:.3g} {unit}, "
            f"mean looking direction ({x:.2f}, {y:.2f}, {z:.2f})"
        )

    def needed_intrinsics(self, path: Path, holder: str) -> Intrinsics:
        """The intrinsics, for a file that must hold them; refuses a trajectory without."""
        if self.intrinsics is None:
            raise InputError(
                f"no intrinsics for {path}"
                + ("" if self.cameras is None else ", but cameras that are not one pinhole"),
                f"{holder} to hold the camera's intrinsics and image size",
                "Pass `intrinsics=fx,fy,cx,cy` and `size=WIDTHxHEIGHT`",
            )
        return self.intrinsics

    def names_or_numbers(self) -> tuple[str, ...]:
        """The names, or ``0000.png``, ``0001.png``, ... without names."""
        return self.names if self.names is not None else tuple(f"{index:04d}.png" for index in range(len(self)))


def natural_order(names: Sequence[str]) -> list[int]:
    """Indices that sort names in natural order, 2 before 10; stable."""
    return sorted(range(len(names)), key=lambda index: _natural(names[index]))


def refuse_repeated(names: Sequence[str], place: str) -> None:
    """Refuse a name that is repeated; the message gives it and its two indices."""
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if first.setdefault(name, index) != index:
            raise InputError(
                f"{place}: '{name}' is repeated (poses {first[name]} and {index})", "one pose for each image"
            )


def _natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    # Numbers before words; the name itself last, to order 01 and 1.
    parts = re.findall(r"\d+|\D+", name)
    digits = [part.lstrip("0") if part.isdecimal() else None for part in parts]
    # By length and then by digits is the order of numbers, also of those too long for int().
    pairs = zip(parts, digits, strict=True)
    return [(1, 0, part) if number is None else (0, len(number), number) for part, number in pairs], name
