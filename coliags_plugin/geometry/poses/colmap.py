"""Reads and writes poses in COLMAP's binary and text sparse models, and writes whole models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, final_place, make_folder
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses.colmap_files import model_suffix, read_cameras, read_images
from coliags_plugin.geometry.poses.formats import Format, prefixed_errors
from coliags_plugin.geometry.poses.rigid import inverse, rigid, rotations_from_wxyz, wxyz_from_rotations
from coliags_plugin.geometry.poses.trajectory import Trajectory, natural_order, refuse_repeated

if TYPE_CHECKING:
    import pycolmap

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
    images = read_images(path / f"images{suffix}", observations=False)
    if not images:
        raise InputError(f"{path / f'images{suffix}'} holds no poses", "at least one registered image")
    refuse_repeated([image.name for image in images], str(path / f"images{suffix}"))
    images = [images[index] for index in natural_order([image.name for image in images])]
    quats_wxyz = np.array([image.quat_wxyz for image in images])
    rotations = rotations_from_wxyz(quats_wxyz, lambda index: images[index].source, unit=True)
    world_to_camera = rigid(rotations, np.array([image.translation for image in images]))
    intrinsics, remark = _common(read_pinholes(path / f"cameras{suffix}"), {image.camera for image in images})
    return Trajectory(
        inverse(world_to_camera),
        names=tuple(image.name for image in images),
        intrinsics=intrinsics,
        stored_as=f"world-to-camera translations and quaternions, w first, {'binary' if suffix == '.bin' else 'text'}",
        remarks=(remark,) if remark else (),
    )


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a binary model of one PINHOLE camera and no points."""
    _write(path, trajectory, text=False)


def write_text(path: Path, trajectory: Trajectory) -> None:
    """Write a text model as :func:`write`; without blanks in names, which COLMAP's reader would truncate."""
    for name in trajectory.names_or_numbers():
        if name.split() != [name]:
            raise InputError(f"the image name '{name}'", "no blanks in a text model", "Write a binary one: colmap")
    _write(path, trajectory, text=True)


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


def _write(path: Path, trajectory: Trajectory, text: bool) -> None:
    intrinsics, names = trajectory.needed_intrinsics(path, "a COLMAP model"), trajectory.names_or_numbers()
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
    seen = f"the COLMAP model written to {final_place(folder)} is incomplete"
    incomplete = InputError(seen, "a disk with space left", "Free some, or choose another output")
    try:
        (model.write_text if text else model.write_binary)(str(folder))
        written = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # what pycolmap raises depends on where the file ends
        raise incomplete from error
    if _counts(written) != _counts(model):
        raise incomplete


def _counts(model: pycolmap.Reconstruction) -> tuple[int, ...]:
    return model.num_cameras(), model.num_reg_images(), model.num_points3D(), model.compute_num_observations()


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


def _common(cameras: dict[int, Intrinsics | str], used: set[int]) -> tuple[Intrinsics | None, str]:
    """The pinhole shared by all images; or None, and the reason."""
    shared = [cameras[number] for number in sorted(used) if number in cameras]
    others = [camera for camera in cameras.values() if isinstance(camera, str)]
    if len(shared) < len(used) or any(isinstance(camera, str) for camera in shared):
        reason = others[0] if others else "the model lacks a camera that an image names"
        return None, f"no intrinsics: {reason}, not an undistorted pinhole"
    pinholes = {camera for camera in shared if isinstance(camera, Intrinsics)}
    if len(pinholes) > 1:
        return None, f"no intrinsics: the images have {len(pinholes)} different cameras"
    return pinholes.pop(), ""


_KEEPS = frozenset({"names", "intrinsics"})
FORMAT = Format("colmap", read, write, lambda path: model_suffix(path, _NEEDED) is not None, keeps=_KEEPS, folder=True)
TEXT_FORMAT = Format("colmap-text", read, write_text, None, keeps=_KEEPS, folder=True)
