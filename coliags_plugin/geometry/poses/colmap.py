"""Reads COLMAP's sparse models, binary and text, their files and poses; writes poses and whole models.

Files are read by hand: pycolmap 4.2.1 trusts every count in a binary file, so that a truncated one makes it hang or
abort the process; it requires files that poses do not need, and names no line in errors. It writes models, and knows
the camera models.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, final_place, make_folder
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.text_files import shortened, text_lines, unreadable
from coliags_plugin.geometry.poses.formats import EXPECTED, Format, prefixed_errors
from coliags_plugin.geometry.poses.trajectory import (
    Trajectory,
    inverse,
    natural_order,
    refuse_repeated,
    rigid,
    rotations_from_wxyz,
    wxyz_from_rotations,
)

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

_Record = TypeVar("_Record")
#: COLMAP's comment on the number of images.
_STATED_COUNT = re.compile(r"Number of images: (\d+)")
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


def read_images(path: Path) -> list[ColmapImage]:
    """Read ``images.bin`` or ``images.txt``."""
    if path.suffix == ".bin":
        return _binary_records(path, _binary_image)
    images, rows, stated = [], text_lines(path, EXPECTED), None
    for number, line in rows:
        if not line.strip() or line.lstrip().startswith("#"):
            stated = stated or _STATED_COUNT.search(line)
            continue
        image = _parsed(path, number, line, _text_image, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, all finite")
        parsed = _parsed(path, *next(rows, (number, "")), _text_observations, "X Y POINT3D_ID of each point")
        images.append(ColmapImage(f"{path}, line {number}", *image, *parsed))
    if stated and int(stated[1]) > len(images):
        log.warning("%s holds %d images, but its header says %s: is it cut short?", path, len(images), stated[1])
    return images


def ordered_images(path: Path) -> list[ColmapImage]:
    """Images as of :func:`read_images`, at least one, in natural order of their names, 2 before 10."""
    images = read_images(path)
    if not images:
        raise InputError(f"{path} holds no poses", "at least one registered image")
    names = [image.name for image in images]
    refuse_repeated(names, str(path))
    if turned := [image for image in images if not any((*image.quat_wxyz[:3], *image.translation))]:
        log.warning(
            "%s: the camera is at the origin, and turned by half a turn about z; does w come last in the file? COLMAP "
            "has QW QX QY QZ",
            turned[0].source,
        )
    return [images[index] for index in natural_order(names)]


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
        raise unreadable(path, message, "a file written by COLMAP", "Copy it again") from error
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
    int(words[0])
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


_NEEDED = ("images", "cameras")
_PARTS = ("cameras", "images", "points3D", "rigs", "frames")
#: Files in a folder that writing a model may replace.
_MODEL_FILES = {f"{part}{suffix}" for part in _PARTS for suffix in (".bin", ".txt")} | {"project.ini"}


def read(path: Path) -> Trajectory:
    """Read the poses of a sparse model, ordered by image name, 2 before 10.

    The folder has ``images`` and ``cameras``, both ``.bin`` or both ``.txt``; binary is preferred.
    """
    suffix = model_suffix(path, _NEEDED)
    if suffix is None:
        raise InputError(
            f"{path} holds no COLMAP model",
            "a folder with images.bin and cameras.bin, or images.txt and cameras.txt",
            "Give the folder of the sparse model itself, often sparse/0",
        )
    images = ordered_images(path / f"images{suffix}")
    used = [image.camera for image in images]
    intrinsics, remark = _common(read_pinholes(path / f"cameras{suffix}"), used)
    keys = {} if intrinsics else {n: _keys(camera) for n, camera in read_cameras(path / f"cameras{suffix}").items()}
    cameras = [keys.get(number) for number in used]
    return Trajectory(
        camera_to_world(images),
        names=tuple(image.name for image in images),
        intrinsics=intrinsics,
        cameras=tuple(camera for camera in cameras if camera) if all(cameras) else None,
        stored_as=f"world-to-camera translations and quaternions, w first, {'binary' if suffix == '.bin' else 'text'}",
        remarks=(remark,) if remark else (),
    )


#: nerfstudio's model of those of COLMAP that it has, and its keys for their parameters; ``f`` is both focal lengths.
_NERFSTUDIO = {
    "SIMPLE_PINHOLE": ("PINHOLE", "f cx cy"),
    "PINHOLE": ("PINHOLE", "fl_x fl_y cx cy"),
    "SIMPLE_RADIAL": ("OPENCV", "f cx cy k1"),
    "RADIAL": ("OPENCV", "f cx cy k1 k2"),
    "OPENCV": ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", "f cx cy k1"),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"),
}


def _keys(camera: ColmapCamera) -> JsonObject | None:
    """A camera by nerfstudio's keys; None of a model that it does not have."""
    model, names = _NERFSTUDIO.get(camera.model, ("", ""))
    keys: JsonObject = dict(zip(names.split(), camera.params, strict=False))
    # nerfstudio's k4 is that of OpenCV's fisheye alone.
    if not model or (model == "OPENCV" and any(keys.pop(key, 0.0) for key in ("k4", "k5", "k6"))):
        return None
    if "f" in keys:
        keys = {"fl_x": keys["f"], "fl_y": keys.pop("f"), **keys}
    return {"camera_model": model, **keys, "w": camera.width, "h": camera.height}


def camera_to_world(images: Sequence[ColmapImage]) -> Float[np.ndarray, "N 4 4"]:
    """Poses of images. [N, 4, 4]"""
    quats_wxyz = np.array([image.quat_wxyz for image in images])
    rotations = rotations_from_wxyz(quats_wxyz, lambda index: images[index].source, unit=True)
    return inverse(rigid(rotations, np.array([image.translation for image in images])))


def colmap_poses(camera_to_world: Float[np.ndarray, "N 4 4"]) -> list[pycolmap.Rigid3d]:
    """World-to-camera transforms of camera-to-world matrices. [N, 4, 4]"""
    import pycolmap

    world_to_camera = inverse(camera_to_world)
    quats_xyzw = wxyz_from_rotations(world_to_camera[:, :3, :3])[:, [1, 2, 3, 0]]
    return [
        pycolmap.Rigid3d(pycolmap.Rotation3d(quat), matrix[:3, 3])
        for quat, matrix in zip(quats_xyzw, world_to_camera, strict=True)
    ]


def posed_model(
    world_to_camera: Sequence[pycolmap.Rigid3d],
    names: Sequence[str],
    cameras: Sequence[Intrinsics],
    camera_indices: Sequence[int],
) -> pycolmap.Reconstruction:
    """A model of posed images without points, of pinholes: image i becomes COLMAP's i + 1, camera k its k + 1.

    ``camera_indices`` has the camera of each image.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    for number, k in enumerate(cameras, start=1):
        params = [k.fx, k.fy, k.cx, k.cy]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="PINHOLE", width=k.width, height=k.height, params=params)
        )
    for index, (pose, name, camera) in enumerate(zip(world_to_camera, names, camera_indices, strict=True)):
        image = pycolmap.Image(name=name, camera_id=camera + 1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pose)
    return model


def write(path: Path, trajectory: Trajectory, text: bool = False) -> None:
    """Write a model of one PINHOLE camera and no points; no text with blanks in names, which COLMAP would truncate."""
    intrinsics, names = trajectory.needed_intrinsics(path, "a COLMAP model"), trajectory.names_or_numbers()
    if text and (blank := [name for name in names if name.split() != [name]]):
        raise InputError(f"the image name '{blank[0]}'", "no blanks in a text model", "Write a binary one: colmap")
    refuse_repeated(names, str(path))
    others = sorted(file.name for file in path.iterdir() if file.name not in _MODEL_FILES) if path.is_dir() else []
    if others:
        raise InputError(f"{path} holds {others[0]}, which is not part of a COLMAP model", "an empty or new folder")
    model = posed_model(colmap_poses(trajectory.camera_to_world), names, [intrinsics], [0] * len(names))
    with atomic_folder(path, overwrite=True) as scratch:
        write_reconstruction(scratch, model, text)


def write_reconstruction(folder: Path, model: pycolmap.Reconstruction, text: bool = False) -> None:
    """Write a COLMAP model into a folder, which is made, and read it back: COLMAP itself ignores a full disk."""
    import pycolmap

    make_folder(folder)
    message = f"the COLMAP model written to {final_place(folder)} is incomplete"
    incomplete = InputError(message, "a disk with space left", "Free some, or choose another output")
    try:
        (model.write_text if text else model.write_binary)(str(folder))
        written = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # what pycolmap raises depends on where the file ends
        raise incomplete from error
    counts = [
        (each.num_cameras(), each.num_reg_images(), each.num_points3D(), each.compute_num_observations())
        for each in (written, model)
    ]
    if counts[0] != counts[1]:
        raise incomplete


def read_pinholes(path: Path) -> dict[int, Intrinsics | str]:
    """Read ``cameras.bin`` or ``cameras.txt`` by ID: the pinhole, or a description of another camera model."""
    pinholes: dict[int, Intrinsics | str] = {}
    for number, camera in read_cameras(path).items():
        if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
            pinholes[number] = f"the camera is {camera.model}"
            continue
        fx, *others = camera.params
        fy, cx, cy = others if camera.model == "PINHOLE" else (fx, *others)
        with prefixed_errors(f"{path}, camera {number}"):
            pinholes[number] = Intrinsics(fx, fy, cx, cy, camera.width, camera.height)
    return pinholes


def _common(cameras: dict[int, Intrinsics | str], used: Sequence[int]) -> tuple[Intrinsics | None, str]:
    """The pinhole shared by all images; or None, and the reason."""
    pinholes = set()
    for number in used:
        camera = cameras.get(number, "the model lacks a camera that an image names")
        if isinstance(camera, str):
            return None, f"no common pinhole: {camera}, not an undistorted pinhole"
        pinholes.add(camera)
    if len(pinholes) > 1:
        return None, f"no common pinhole: the images have {len(pinholes)} different cameras"
    return pinholes.pop(), ""


_KEEPS = frozenset({"names", "intrinsics"})
FORMAT = Format("colmap", read, write, lambda path: model_suffix(path, _NEEDED) is not None, keeps=_KEEPS, folder=True)
TEXT_FORMAT = Format("colmap-text", read, partial(write, text=True), None, keeps=_KEEPS, folder=True)
