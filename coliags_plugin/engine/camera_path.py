"""Camera paths: keyframes in a file, and the cameras of a video between them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from pydantic import Field, field_validator

from coliags_plugin.config.yaml_tree import tuples
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import Settings, invalid_reported
from coliags_plugin.reporting.video import check_rate

_EXPECTED = "a camera path as `coliags view` saves it (docs/viewer.md 6)"
#: How far the rows of a rotation may be from orthonormal.
_TOLERANCE = 1e-4


class Keyframe(Settings):
    """A camera of a path: its pose in OpenCV's axes, scene units, and its vertical field of view."""

    camera_to_world: tuple[tuple[float, float, float, float], ...]  # 4 rows
    vertical_fov_degrees: float = Field(gt=0, lt=180)

    @classmethod
    def of(cls, camera: Camera) -> Keyframe:
        """The keyframe of a camera."""
        fov = 2.0 * math.degrees(math.atan(0.5 * camera.height / camera.fy))
        rows = tuple(map(tuple, camera.camera_to_world.double().tolist()))
        return cls(camera_to_world=rows, vertical_fov_degrees=fov)

    @field_validator("camera_to_world")
    @classmethod
    def _rigid(cls, rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        matrix = np.array(rows)
        turn = matrix[:3, :3]
        if (
            matrix.shape != (4, 4)
            or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]
            or np.abs(turn @ turn.T - np.eye(3)).max() > _TOLERANCE
            or np.linalg.det(turn) < 0.0
        ):
            raise ValueError("not a rotation and a translation, 4 rows of 4 numbers, the last one 0 0 0 1")
        return rows


class CameraPath(Settings):
    """Keyframes that a camera passes at equal times."""

    keyframes: tuple[Keyframe, ...] = Field(min_length=2, max_length=1000)
    seconds: float = Field(default=2.0, gt=0, le=60)  # from one keyframe to the next

    def write(self, file: Path) -> None:
        """Write the path as JSON, atomically."""
        write_json(file, self.model_dump())

    @classmethod
    def read(cls, file: Path) -> CameraPath:
        """Read a path; InputError where the file is none."""
        with invalid_reported(f"{file}: ", _EXPECTED):
            return cls.model_validate(tuples(read_json(file, _EXPECTED, finite=True)))

    def cameras(self, like: Camera, fps: float) -> Iterator[Camera]:
        """Cameras of a video at a rate, of the size and near plane of a camera, with the principal point in the middle.

        Places and fields of view go smoothly and do not leave the range of the two keyframes around them (PCHIP);
        directions follow a spline of rotations.
        """
        from scipy.interpolate import PchipInterpolator
        from scipy.spatial.transform import Rotation, RotationSpline

        check_rate(fps)
        poses = np.array([keyframe.camera_to_world for keyframe in self.keyframes])
        at = self.seconds * np.arange(len(poses))
        times = np.linspace(0.0, at[-1], max(2, round(at[-1] * fps) + 1))
        centers = PchipInterpolator(at, poses[:, :3, 3])(times)
        turns = RotationSpline(at, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
        fovs = PchipInterpolator(at, [keyframe.vertical_fov_degrees for keyframe in self.keyframes])(times)
        for center, turn, fov in zip(centers, turns, fovs, strict=True):
            focal, matrix = 0.5 * like.height / math.tan(0.5 * math.radians(fov)), torch.eye(4)
            matrix[:3, :3], matrix[:3, 3] = torch.from_numpy(turn), torch.from_numpy(center)
            yield Camera(
                focal, focal, 0.5 * like.width, 0.5 * like.height, like.width, like.height, matrix, like.near_plane
            )
