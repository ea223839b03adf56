"""Reads the files of COLMAP's sparse models, binary and text.

By hand: pycolmap 4.2.1 trusts every count in a binary file, so that a truncated one makes it hang or abort the process;
it requires files that poses do not need, and names no line in errors. It writes models
(:mod:`coliags_plugin.geometry.poses.colmap`), and knows the camera models.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import text_lines
from coliags_plugin.geometry.poses.formats import EXPECTED, shortened

_Record = TypeVar("_Record")
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


class ColmapCamera(NamedTuple):
    """A camera: COLMAP's ID, name of its model, image size in pixels, and the model's parameters."""

    number: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image."""

    source: str  # its file, and line or ID, for messages
    quat_wxyz: tuple[float, ...]  # world to camera, as stored
    translation: tuple[float, ...]  # world to camera
    camera: int  # ID of its camera
    name: str  # path relative to the folder of images
    observed: Float[np.ndarray, "K 2"]  # observed keypoints of points, pixels, centres at integers + 0.5
    points: Int[np.ndarray, "K"]  # their points' IDs


class ColmapPoint(NamedTuple):
    """A sparse point: ID, position in the world [3], RGB [3], and number of observations."""

    number: int
    position: Float[np.ndarray, "3"]
    color: UInt8[np.ndarray, "3"]
    track_length: int


def model_suffix(folder: Path, parts: tuple[str, ...]) -> str | None:
    """``.bin`` or, failing that, ``.txt``, where a folder has all of some parts of a model; else None."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in parts):
            return suffix
    return None


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read ``cameras.bin`` or ``cameras.txt``, by ID."""
    if path.suffix == ".bin":
        cameras = _binary_records(path, _binary_camera)
    else:
        cameras = [_parsed(path, *row, _text_camera, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") for row in _rows(path)]
    return {camera.number: camera for camera in cameras}


def read_images(path: Path, observations: bool = True) -> list[ColmapImage]:
    """Read ``images.bin`` or ``images.txt``.

    Without ``observations`` those of a text file, nearly all of its length, are not parsed, and there are none.
    """
    if path.suffix == ".bin":
        return _binary_records(path, _binary_image)
    images, rows = [], text_lines(path, EXPECTED)
    for number, line in rows:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        image = _parsed(path, number, line, _text_image, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, all finite")
        second, observed = next(rows, (number, ""))
        parsed = _parsed(
            path, second, observed if observations else "", _text_observations, "X Y POINT3D_ID of each point"
        )
        images.append(ColmapImage(f"{path}, line {number}", *image, *parsed))
    return images


def read_points(path: Path) -> list[ColmapPoint]:
    """Read ``points3D.bin`` or ``points3D.txt``, in the order of their IDs."""
    if path.suffix == ".bin":
        points = _binary_records(path, _binary_point)
    else:
        points = [_parsed(path, *row, _text_point, "POINT3D_ID X Y Z R G B ERROR TRACK") for row in _rows(path)]
    points = sorted(points, key=lambda point: point.number)
    for point, other in pairwise(points):
        if point.number == other.number:
            raise InputError(f"{path} holds point {point.number} twice", "each once", "Copy the file again")
    return points


class _Cursor:
    """Position in a binary file."""

    def __init__(self, path: Path) -> None:
        self.path, self.position = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror or error}", "a file of a COLMAP model") from error

    def unpack(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from(form, self.data, self.position)
        self.position += struct.calcsize(form)
        return values

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        size = count * kind.itemsize
        if self.position + size > len(self.data):
            raise ValueError("cut short")
        values = np.frombuffer(self.data, kind, count, self.position)
        self.position += size
        return values

    def text(self) -> str:
        begin, end = self.position, self.data.index(b"\0", self.position)
        self.position = end + 1
        return self.data[begin:end].decode()


def _binary_records(path: Path, read: Callable[[_Cursor], _Record]) -> list[_Record]:
    cursor = _Cursor(path)
    try:
        records = [read(cursor) for _ in range(*cursor.unpack("<Q"))]
        if cursor.position != len(cursor.data):
            raise ValueError("more than the records")
    except (struct.error, ValueError, OverflowError) as error:
        message = f"{path} ({len(cursor.data)} bytes) is damaged or cut short"
        raise InputError(message, "a file written by COLMAP", "Copy it again") from error
    return records


def _binary_camera(cursor: _Cursor) -> ColmapCamera:
    number, model, width, height = cursor.unpack("<IiQQ")
    name, count = _camera_model(model)
    return ColmapCamera(number, name, width, height, cursor.unpack(f"<{count}d"))


def _binary_image(cursor: _Cursor) -> ColmapImage:
    number, *pose, camera = cursor.unpack("<I7dI")
    name = cursor.text()
    source = f"{cursor.path}, image {number} ({name})"
    if not np.all(np.isfinite(pose)):
        raise InputError(f"{source}: its pose is {', '.join(f'{v:g}' for v in pose)}", "seven finite numbers")
    observed = cursor.array(_OBSERVATION, *cursor.unpack("<Q"))
    observed = observed[observed["point"] != -1]
    return ColmapImage(source, tuple(pose[:4]), tuple(pose[4:]), camera, name, observed["pixel"], observed["point"])


def _binary_point(cursor: _Cursor) -> ColmapPoint:
    number, *position, red, green, blue, _, length = cursor.unpack("<Q3d3BdQ")
    cursor.array(np.dtype("<u8"), length)
    return ColmapPoint(number, np.array(position), np.array([red, green, blue], np.uint8), length)


def _rows(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor comments, with their numbers."""
    return (row for row in text_lines(path, EXPECTED) if row[1].strip() and not row[1].lstrip().startswith("#"))


def _parsed(path: Path, number: int, line: str, parse: Callable[[str], _Record], expected: str) -> _Record:
    try:
        return parse(line)
    except (ValueError, IndexError, OverflowError) as error:
        advice = "Each image has two lines; the second lists its points and may be empty, but must exist"
        raise InputError(
            f"{path}, line {number}: '{shortened(line)}'", expected, advice if path.stem == "images" else ""
        ) from error


def _text_camera(line: str) -> ColmapCamera:
    number, model, width, height, *params = line.split()
    if len(params) != _camera_model(model)[1]:
        raise ValueError("another number of parameters")
    return ColmapCamera(int(number), model, int(width), int(height), tuple(float(word) for word in params))


def _text_image(line: str) -> tuple[tuple[float, ...], tuple[float, ...], int, str]:
    words = line.split(maxsplit=9)
    pose = tuple(float(word) for word in words[1:8])
    if not np.all(np.isfinite(pose)):
        raise ValueError("not finite")
    return pose[:4], pose[4:], int(words[8]), words[9].strip()


def _text_observations(line: str) -> tuple[Float[np.ndarray, "K 2"], Int[np.ndarray, "K"]]:
    words = line.split()
    if len(words) % 3:
        raise ValueError("an observation is of three")
    points = np.array([int(word) for word in words[2::3]], np.int64)
    pixels = np.array([[float(word) for word in words[axis::3]] for axis in range(2)]).T
    return pixels[points != -1], points[points != -1]


def _text_point(line: str) -> ColmapPoint:
    number, x, y, z, red, green, blue, _, *track = line.split()
    if len(track) % 2:
        raise ValueError("a track is of pairs")
    color = np.array([int(red), int(green), int(blue)], np.uint8)
    return ColmapPoint(int(number), np.array([float(x), float(y), float(z)]), color, len(track) // 2)


@cache
def _camera_model(model: int | str) -> tuple[str, int]:
    """Name of a camera model, by its ID or name, and the number of its parameters. Raises ValueError."""
    import pycolmap

    if isinstance(model, str):
        camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1)
    else:
        camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return camera.model_name, len(camera.params)
