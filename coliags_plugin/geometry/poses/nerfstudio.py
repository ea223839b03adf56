"""Reads and writes poses in ``transforms.json`` of nerfstudio, instant-ngp and Blender's NeRF scenes.

Poses are camera-to-world with OpenGL axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import JsonObject, read_json, read_number
from coliags_plugin.geometry.poses.formats import Format, head_text, prefixed_errors
from coliags_plugin.geometry.poses.trajectory import (
    FLIP_Y_AND_Z,
    Trajectory,
    check_rigid,
    natural_order,
    refuse_repeated,
)

_PINHOLE = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Keys of a camera, of the file or of a frame.
_CAMERA = (*_PINHOLE, *_DISTORTION, "k5", "k6", "camera_model", "is_fisheye", "camera_angle_x", "camera_angle_y")
_UNDISTORTED = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE")


def read(path: Path) -> Trajectory:
    """Read ``frames[].transform_matrix``, ordered by ``file_path``, 2 before 10.

    nerfstudio's conversion transforms the world and stores that in ``applied_transform`` (and ``applied_scale``); it is
    undone, so that poses are in their original world.
    """
    content = read_json(path, "a transforms.json")
    if not isinstance(content, dict):
        raise InputError(f"{path} holds a JSON {type(content).__name__}", "a JSON object with 'frames'")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} has no frames", "'frames': [{'file_path': ..., 'transform_matrix': ...}, ...]")
    names, matrices = [], []
    for index, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name:
            raise InputError(f"{path}, frame {index}: no file_path", "the name of the frame's image")
        names.append(name)
        matrices.append(_matrix(frame.get("transform_matrix"), f"{path}, frame {index} ({name}): transform_matrix"))
    refuse_repeated(names, str(path))
    remarks = []
    camera_to_world = np.array(matrices)
    check_rigid(camera_to_world, lambda index: f"{path}, frame {index} ({names[index]})")
    if "applied_transform" in content or "applied_scale" in content:
        applied = _matrix(content.get("applied_transform", np.eye(4)), f"{path}: applied_transform")
        check_rigid(applied[None], lambda _: f"{path}: applied_transform")
        scale = read_number({"applied_scale": 1.0} | content, "applied_scale", path, "a positive number", above=0.0)
        camera_to_world[:, :3, 3] /= scale
        camera_to_world = np.asarray(np.linalg.inv(applied) @ camera_to_world)
        remarks.append("nerfstudio's change of the world (applied_transform) is undone")
    order = natural_order(names)
    if order != list(range(len(order))):
        remarks.append("frames are put in the order of their names")
    intrinsics, remark = _intrinsics(path, content, frames)
    cameras = [{key: value for key, value in ({**content, **frame}).items() if key in _CAMERA} for frame in frames]
    return Trajectory(
        (camera_to_world @ FLIP_Y_AND_Z)[order],
        names=tuple(names[index] for index in order),
        intrinsics=intrinsics,
        cameras=tuple(cameras[index] for index in order) if intrinsics is None and any(cameras) else None,
        stored_as="camera-to-world matrices, OpenGL axes",
        remarks=(*remarks, *([remark] if remark else [])),
    )


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a ``transforms.json``, with the camera of all frames, or of each, if known."""
    names = trajectory.names_or_numbers()
    refuse_repeated(names, str(path))
    content: dict[str, Any] = {}
    if (pinhole := trajectory.intrinsics) is not None:
        numbers = (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, pinhole.width, pinhole.height)
        content = {"camera_model": "PINHOLE", **dict(zip(_PINHOLE, numbers, strict=True))}
    cameras: Sequence[JsonObject] = trajectory.cameras or [{}] * len(trajectory)
    # nerfstudio reads the model of the file alone, and no distortion of frames where the file has any.
    common = cameras[0].keys() if all(camera == cameras[0] for camera in cameras) else {"camera_model"}
    content |= {
        key: cameras[0][key] for key in common if all(each.get(key) == cameras[0].get(key, ()) for each in cameras)
    }
    opengl = trajectory.camera_to_world @ FLIP_Y_AND_Z
    content["frames"] = [
        {"file_path": name, "transform_matrix": matrix.tolist()} | {k: camera[k] for k in camera if k not in content}
        for name, matrix, camera in zip(names, opengl, cameras, strict=True)
    ]
    write_json(path, content)


def _matrix(value: Any, place: str) -> np.ndarray:
    """Finite matrix from nested lists of four or three rows. [4, 4]"""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    expected = "4 (or 3) rows of 4 finite numbers"
    if matrix.shape != (4, 4):
        raise InputError(f"{place} is {'missing' if value is None else 'not a matrix'}", expected)
    if not np.all(np.isfinite(matrix)):
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise InputError(f"{place} is {matrix[row, column]} in row {row}, column {column}", expected)
    return matrix


def _intrinsics(path: Path, content: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[Intrinsics | None, str]:
    """The pinhole shared by all images; or None, and the reason."""
    pinholes: set[Intrinsics] = set()
    for frame in frames:
        # A frame's value overrides the file's.
        values = {
            key: frame.get(key, content.get(key)) for key in (*_PINHOLE, *_DISTORTION, "camera_model", "camera_angle_x")
        }
        model = values.pop("camera_model")
        if model not in (None, *_UNDISTORTED) or any(values[key] for key in _DISTORTION):
            return None, f"no common pinhole: the camera ({model or 'OPENCV'}) is distorted"
        if values["fl_x"] is None and values["camera_angle_x"] is not None and values["w"] and values["h"]:
            # Blender's form: square pixels, the principal point in the middle.
            half_width, half_height = (0.5 * read_number(values, key, path) for key in ("w", "h"))
            focal_length = half_width / math.tan(0.5 * read_number(values, "camera_angle_x", path))
            values |= {"fl_x": focal_length, "fl_y": focal_length, "cx": half_width, "cy": half_height}
        missing = [key for key in _PINHOLE if values[key] is None]
        if missing:
            return None, f"no intrinsics: the file has no {', '.join(missing)}"
        fx, fy, cx, cy, width, height = (read_number(values, key, path) for key in _PINHOLE)
        with prefixed_errors(str(path)):
            pinholes.add(Intrinsics(fx, fy, cx, cy, round(width), round(height)))
    if len(pinholes) > 1:
        return None, f"no common pinhole: the images have {len(pinholes)} different cameras"
    return pinholes.pop(), ""


FORMAT = Format(
    "nerfstudio",
    read,
    write,
    lambda path: head_text(path).lstrip().startswith("{"),  # a JSON object
    keeps=frozenset({"names", "intrinsics", "cameras"}),
)
