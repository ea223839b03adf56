"""Reads and writes the poses of COLMAP's binary and text sparse models.

Poses are read without pycolmap, which requires further files, names no line in errors, and aborts the process on a
truncated binary file (4.2.1). Models are written with it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, make_folder
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scratch import final_place
from coliags_plugin.core.text_files import text_lines
from coliags_plugin.geometry.poses.format import Format
from coliags_plugin.geometry.poses.rigid import inverse, rigid, rotations_from_wxyz, wxyz_from_rotations
from coliags_plugin.geometry.poses.text import EXPECTED, prefixed_errors, shortened
from coliags_plugin.geometry.poses.trajectory import Trajectory, natural_order, refuse_repeated

if TYPE_CHECKING:
    import pycolmap

#: Models without distortion by COLMAP's ID, with the number of their parameters.
_PINHOLES = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4)}
_PARTS = ("cameras", "images", "points3D", "rigs", "frames")
#: Files in a folder that writing a model may replace.
_MODEL_FILES = {f"{part}{suffix}" for part in _PARTS for suffix in (".bin", ".txt")} | {"project.ini"}
_BINARY_IMAGE = struct.Struct("<I7dI")
_POINT_BYTES = 24


@dataclass(frozen=True)
class _Image:
    place: str
    quat_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def read(path: Path) -> Trajectory:
    """Read the poses of a sparse model, ordered by image name, 2 before 10.

    Args:
        path: A folder with ``images`` and ``cameras``, both ``.bin`` or both ``.txt``; binary is preferred.

    Raises:
        InputError: The files are missing, damaged or empty; or a quaternion is zero or further than 1e-3 from unit
            length (the message names the line or image); or an image is repeated.
    """
    suffix = _suffix(path)
    if suffix is None:
        raise InputError(
            f"{path} holds no COLMAP model",
            "a folder with images.bin and cameras.bin, or images.txt and cameras.txt",
            "Give the folder of the sparse model itself, often sparse/0",
        )
    read_images, read_cameras = (
        (_binary_images, _binary_cameras) if suffix == ".bin" else (_text_images, read_text_cameras)
    )
    images = list(read_images(path / f"images{suffix}"))
    if not images:
        raise InputError(f"{path / f'images{suffix}'} holds no poses", "at least one registered image")
    refuse_repeated([image.name for image in images], str(path / f"images{suffix}"))
    images = [images[index] for index in natural_order([image.name for image in images])]
    quats_wxyz = np.array([image.quat_wxyz for image in images])
    rotations = rotations_from_wxyz(quats_wxyz, lambda index: images[index].place, unit=True)
    world_to_camera = rigid(rotations, np.array([image.translation for image in images]))
    intrinsics, remark = _common(read_cameras(path / f"cameras{suffix}"), {image.camera for image in images})
    return Trajectory(
        inverse(world_to_camera),
        names=tuple(image.name for image in images),
        intrinsics=intrinsics,
        stored_as=f"world-to-camera translations and quaternions, w first, {'binary' if suffix == '.bin' else 'text'}",
        remarks=(remark,) if remark else (),
    )


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a binary model of one PINHOLE camera and no points.

    Raises:
        InputError: The trajectory has no intrinsics, a name is repeated, the folder holds something other than a
            COLMAP model, or it cannot be written.
    """
    _write(path, trajectory, text=False)


def write_text(path: Path, trajectory: Trajectory) -> None:
    """Write a text model of one PINHOLE camera and no points; as :func:`write`.

    Raises:
        InputError: As :func:`write`; or a name has blanks, which COLMAP's reader would truncate.
    """
    for name in trajectory.names_or_numbers():
        if name.split() != [name]:
            raise InputError(f"the image name '{name}'", "no blanks in a text model", "Write a binary one: colmap")
    _write(path, trajectory, text=True)


def recognise(path: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return _suffix(path) is not None


def _suffix(path: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((path / f"{part}{suffix}").is_file() for part in ("images", "cameras")):
            return suffix
    return None


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
    """A model of posed images without points: image i becomes COLMAP's image i + 1, camera k its camera k + 1.

    Args:
        world_to_camera: World-to-camera transforms of the images, OpenCV axes.
        names: Image names.
        cameras: Undistorted pinholes.
        camera_indices: Camera index of each image.
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


def _write(path: Path, trajectory: Trajectory, text: bool) -> None:
    if trajectory.intrinsics is None:
        raise InputError(
            f"no intrinsics for {path}",
            "a COLMAP model to hold the camera's intrinsics and image size",
            "Pass --intrinsics fx,fy,cx,cy --size WIDTHxHEIGHT",
        )
    refuse_repeated(trajectory.names_or_numbers(), str(path))
    others = sorted(found.name for found in path.iterdir() if found.name not in _MODEL_FILES) if path.is_dir() else []
    if others:
        raise InputError(f"{path} holds {others[0]}, which is not part of a COLMAP model", "an empty or new folder")
    names = trajectory.names_or_numbers()
    model = posed_model(colmap_poses(trajectory.camera_to_world), names, [trajectory.intrinsics], [0] * len(names))
    with atomic_folder(path, overwrite=True) as scratch:
        write_reconstruction(scratch, model, text)


def write_reconstruction(folder: Path, model: pycolmap.Reconstruction, text: bool = False) -> None:
    """Write a COLMAP model into a folder, which is made, and read it back: COLMAP itself ignores a full disk.

    Raises:
        InputError: The folder cannot be written.
    """
    import pycolmap

    make_folder(folder)
    try:
        (model.write_text if text else model.write_binary)(str(folder))
        written = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # what pycolmap raises depends on where the file ends
        raise _incomplete(folder) from error
    if _counts(written) != _counts(model):
        raise _incomplete(folder)


def _counts(model: pycolmap.Reconstruction) -> tuple[int, ...]:
    return model.num_cameras(), model.num_images(), model.num_points3D(), model.compute_num_observations()


def _incomplete(folder: Path) -> InputError:
    return InputError(
        f"the COLMAP model written to {final_place(folder)} is incomplete",
        "a disk with space left",
        "Free some, or choose another output",
    )


def _text_images(path: Path) -> Iterator[_Image]:
    lines = text_lines(path, EXPECTED)
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        place = f"{path}, line {number}"
        words = line.split(maxsplit=9)
        try:
            values = [float(word) for word in words[1:8]]
            image = _Image(place, tuple(values[:4]), tuple(values[4:]), int(words[8]), words[9].strip())
            if not np.all(np.isfinite(values)):
                raise ValueError("not finite")
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{place}: '{shortened(line)}'",
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, all numbers finite",
                "Each image has two lines; the second lists its points and may be empty, but must exist",
            ) from error
        yield image
        next(lines, None)  # the image's points


def read_text_cameras(path: Path) -> dict[int, Intrinsics | str]:
    """Read the cameras of a ``cameras.txt`` by ID: the pinhole, or a description of another camera model.

    Raises:
        InputError: The file cannot be read, or a line is not a camera; the message names the line.
    """
    cameras: dict[int, Intrinsics | str] = {}
    for number, line in text_lines(path, EXPECTED):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            with prefixed_errors(f"{path}, line {number}"):
                cameras[int(words[0])] = _camera(words[1], int(words[2]), int(words[3]), [float(w) for w in words[4:]])
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}, line {number}: '{shortened(line)}'", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            ) from error
    return cameras


def _binary_images(path: Path) -> Iterator[_Image]:
    data = _bytes(path)
    try:
        (count,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(count):
            number, *values, camera = _BINARY_IMAGE.unpack_from(data, at)
            end = data.index(b"\0", at + _BINARY_IMAGE.size)
            name = data[at + _BINARY_IMAGE.size : end].decode()
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + _POINT_BYTES * points
            if at > len(data):
                raise ValueError("out of bounds")
            place = f"{path}, image {number} ({name})"
            if not np.all(np.isfinite(values)):
                raise InputError(f"{place}: its pose is {', '.join(f'{v:g}' for v in values)}", "seven finite numbers")
            yield _Image(place, tuple(values[:4]), tuple(values[4:]), camera, name)
    except (struct.error, ValueError) as error:
        raise _damaged(path, data) from error
    if at != len(data):
        raise _damaged(path, data)


def _binary_cameras(path: Path) -> dict[int, Intrinsics | str]:
    data = _bytes(path)
    cameras: dict[int, Intrinsics | str] = {}
    try:
        (count,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(count):
            number, model, width, height = struct.unpack_from("<IiQQ", data, at)
            if model not in _PINHOLES:
                # The number of its parameters is unknown, and the images cannot share one pinhole any more.
                cameras[number] = f"camera {number} is COLMAP's model {model}"
                return cameras
            name, parameters = _PINHOLES[model]
            values = struct.unpack_from(f"<{parameters}d", data, at + 24)
            with prefixed_errors(f"{path}, camera {number}"):
                cameras[number] = _camera(name, width, height, list(values))
            at += 24 + 8 * parameters
    except struct.error as error:
        raise _damaged(path, data) from error
    return cameras


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error}", "a file of a COLMAP model") from error


def _damaged(path: Path, data: bytes) -> InputError:
    return InputError(
        f"{path} ({len(data)} bytes) is damaged or cut short", "a file written by COLMAP", "Copy it again"
    )


def _camera(model: str, width: int, height: int, parameters: list[float]) -> Intrinsics | str:
    """The pinhole, or a description of another camera model."""
    if model == "PINHOLE":
        fx, fy, cx, cy = parameters
    elif model == "SIMPLE_PINHOLE":
        fx, cx, cy = parameters
        fy = fx
    else:
        return f"the camera is {model}"
    return Intrinsics(fx, fy, cx, cy, width, height)


def _common(cameras: dict[int, Intrinsics | str], used: set[int]) -> tuple[Intrinsics | None, str]:
    """The pinhole shared by all images; or None, and the reason."""
    found = [cameras[number] for number in sorted(used) if number in cameras]
    others = [camera for camera in cameras.values() if isinstance(camera, str)]
    if len(found) < len(used) or any(isinstance(camera, str) for camera in found):
        reason = others[0] if others else "the model lacks a camera that an image names"
        return None, f"no intrinsics: {reason}, not an undistorted pinhole"
    pinholes = {camera for camera in found if isinstance(camera, Intrinsics)}
    if len(pinholes) > 1:
        return None, f"no intrinsics: the images have {len(pinholes)} different cameras"
    return pinholes.pop(), ""


_KEEPS = frozenset({"names", "intrinsics"})
FORMAT = Format("colmap", read, write, recognise, keeps=_KEEPS, folder=True)
TEXT_FORMAT = Format("colmap-text", read, write_text, None, keeps=_KEEPS, folder=True)
