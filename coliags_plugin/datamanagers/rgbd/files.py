"""Finding the files of a scene in TUM's RGB-D layout: images, depth, trajectory and camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json, read_number
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.core.text_files import read_text
from coliags_plugin.datamanagers.reading.camera_json import read_intrinsics
from coliags_plugin.datamanagers.reading.files import DEPTH_SUFFIXES, IMAGE_SUFFIXES, inventory, require_folder
from coliags_plugin.datamanagers.reading.images import size_of
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.geometry.lenses.vicalib import calibration_files, find_calibration
from coliags_plugin.geometry.meshes.files import read_mesh
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.colmap import read_pinholes
from coliags_plugin.geometry.poses.formats import shortened
from coliags_plugin.geometry.poses.trajectory import natural_order

IMAGE_FOLDERS = ("rgb", "color", "images")
DEPTH_FOLDERS = ("depth", "depths")
MASK_FOLDERS = ("mask", "masks")
CONFIDENCE_FOLDERS = ("confidence",)
TRAJECTORIES = ("groundtruth.txt", "poses.txt", "traj.txt", "trajectory.txt", "*_poses.txt")
CAMERA_FILES = ("camera.json", "intrinsics.txt", "cameras.txt")
EXPECTED = (
    f"{', '.join(f'{name}/' for name in IMAGE_FOLDERS)} with images, a TUM trajectory ({', '.join(TRAJECTORIES)}) "
    f"and one of {', '.join(CAMERA_FILES)} or a calibration file (docs/layouts/endomapper.md)"
)
#: Where the principal point of an image may lie, as a share of its size, when nothing says which size it is for.
_MIDDLE = (0.3, 0.7)
#: A file stem that is a timestamp in seconds with a fraction, as TUM's, with an optional suffix.
_TIME = re.compile(r"(\d+\.\d+)(?:_[a-z]+)?", re.IGNORECASE)


@dataclass(frozen=True)
class CameraFile:
    """Contents of a camera file; ``depth_scale`` in depth steps per scene unit, None if not given."""

    path: Path
    lens: Lens  # of the stored images
    depth_scale: float | None = None


def recognise(folder: Path) -> str | None:
    """The files that identify this layout; None if the folder has another one."""
    images = next((name for name in IMAGE_FOLDERS if (folder / name).is_dir()), None)
    trajectory = next((path for path in _trajectories(folder) if tum.recognise(path)), None)
    if images is None or trajectory is None:
        return None
    return f"the TUM trajectory {trajectory.name} beside {images}/"


def find_images(folder: Path) -> list[Path]:
    """The colour images, unordered; there must be one folder of them."""
    require_folder(folder, EXPECTED)
    image_folder = _only(folder, IMAGE_FOLDERS)
    if image_folder is None:
        raise InputError(f"{folder} holds {inventory(folder)}", EXPECTED, "Name the scene's own folder")
    images = [path for path in image_folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise InputError(f"{image_folder} holds {inventory(image_folder)}", "PNG or JPEG images")
    return images


def find_depths(folder: Path) -> list[Path]:
    """The depth files, unordered; empty without a folder of them."""
    depths = _only(folder, DEPTH_FOLDERS)
    return [] if depths is None else [path for path in depths.iterdir() if path.suffix.lower() in DEPTH_SUFFIXES]


def files_of_images(folder: Path, names: tuple[str, ...], images: Sequence[Path], what: str) -> dict[str, Path]:
    """Files of images, such as masks, by the stem of their image; empty without a folder of one of the ``names``.

    Such a folder must have one for every image; ``what`` they are is for the error.
    """
    file_folder = _only(folder, names)
    if file_folder is None:
        return {}
    files = {path.stem: path for path in file_folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES}
    lone = next((image for image in images if image.stem not in files), None)
    if lone is not None:
        raise InputError(
            f"{file_folder} has no {what} for {lone.name}",
            f"a {what} of the same name for every image, or no such folder",
            "Restore the missing ones, or move the folder away",
        )
    return {image.stem: files[image.stem] for image in images}


def is_calibrated(folder: Path) -> bool:
    """Whether the camera of a folder is that of a calibration file."""
    return not any((folder / name).is_file() for name in CAMERA_FILES) and bool(calibration_files(folder))


def find_trajectory(folder: Path, named: str | None) -> Path:
    """The trajectory file: the one the user names, relative to the folder or absolute, or the only one there is."""
    if named is not None:
        if not (folder / named).is_file():
            raise InputError(f"no file {folder / named}", "a TUM trajectory", "Correct the option trajectory")
        return folder / named
    trajectories = _trajectories(folder)
    if not trajectories:
        raise InputError(
            f"{folder} has images but no {' or '.join(TRAJECTORIES)}",
            EXPECTED,
            "Add the trajectory of the SLAM system that tracked the video, or estimate poses by coliags poses sfm",
        )
    if len(trajectories) > 1:
        raise InputError(
            f"{folder} has the trajectories {', '.join(path.name for path in trajectories)}",
            "one trajectory",
            f"Choose with the option trajectory, for instance --set datamanager.trajectory={trajectories[0].name}",
        )
    return trajectories[0]


def find_camera(folder: Path, image: Path) -> CameraFile:
    """The camera: of ``camera.json``, ``intrinsics.txt``, COLMAP's ``cameras.txt`` or a calibration file, the first.

    ``image`` is one of the scene's, for the size if the file has none.
    """
    for name, read in zip(CAMERA_FILES, (_read_json, _read_intrinsics_txt, _read_cameras_txt), strict=True):
        if (folder / name).is_file():
            return read(folder / name, image)
    calibration = find_calibration(folder)
    if calibration is None:
        seen = f"{folder} has images but no {', '.join(CAMERA_FILES)} or calibration file"
        raise InputError(seen, EXPECTED, "Add the camera")
    return CameraFile(calibration.path, calibration.lens, calibration.depth_scale)


def find_mesh(folder: Path) -> Path | None:
    """The OBJ file of the folder; None if there is none or several."""
    meshes = sorted(folder.glob("*.obj"))
    return meshes[0] if len(meshes) == 1 else None


def read_mesh_points(path: Path) -> PointCloud:
    """The vertices of a mesh, and their colours if all have one."""
    mesh = read_mesh(path)
    return PointCloud(torch.from_numpy(mesh.vertices), None if mesh.colors is None else torch.from_numpy(mesh.colors))


def _only(folder: Path, names: tuple[str, ...]) -> Path | None:
    folders = [folder / name for name in names if (folder / name).is_dir()]
    if len(folders) > 1:
        listed = " and ".join(f"{path.name}/" for path in folders)
        raise InputError(f"{folder} holds {listed}", "only one of them", "Move the other away")
    return folders[0] if folders else None


def _trajectories(folder: Path) -> list[Path]:
    return sorted({path for pattern in TRAJECTORIES for path in folder.glob(pattern) if path.is_file()})


def _read_json(path: Path, image: Path) -> CameraFile:
    lens = PinholeLens.of(read_intrinsics(path))
    content = read_json(path, "a JSON object")
    if content.get("depth_scale") is None:
        return CameraFile(path, lens)
    expected = "a number above 0: depth steps per scene unit"
    return CameraFile(path, lens, read_number(content, "depth_scale", path, expected, above=0.0))


def _read_intrinsics_txt(path: Path, image: Path) -> CameraFile:
    words = [word for line in read_text(path, "numbers").splitlines() for word in line.replace(",", " ").split()]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) == 9:
        fx, skew, cx, below, fy, cy, *last = values
        if (skew, below, *last) != (0.0, 0.0, 0.0, 0.0, 1.0):
            raise InputError(f"{path}: {shortened(' '.join(words))}", "K = fx 0 cx, 0 fy cy, 0 0 1, without skew")
        values = [fx, fy, cx, cy]
    if len(values) != 4 or not np.all(np.isfinite(values)) or min(values[:2]) <= 0.0:
        raise InputError(f"{path}: '{shortened(' '.join(words))}'", "fx fy cx cy, or the nine numbers of K; pixels")
    width, height = size_of(image)
    fx, fy, cx, cy = values
    if not all(_MIDDLE[0] < share < _MIDDLE[1] for share in (cx / width, cy / height)):
        raise InputError(
            f"{path}: the principal point ({cx:g}, {cy:g}) is far from the middle of {image.name}, {width} x {height}",
            "intrinsics of the images as they are stored",
            "Scale them, or say their size in a camera.json with fx, fy, cx, cy, w, h if that is where it is",
        )
    # OpenCV's K: pixel centres at integers.
    return CameraFile(path, PinholeLens(fx, fy, cx + 0.5, cy + 0.5, width, height))


def _read_cameras_txt(path: Path, image: Path) -> CameraFile:
    cameras = list(read_pinholes(path).values())
    if len(cameras) != 1:
        raise InputError(f"{path} has {len(cameras)} cameras", "one, PINHOLE or SIMPLE_PINHOLE")
    camera = cameras[0]
    if isinstance(camera, str):
        raise InputError(f"{path}: {camera}", "PINHOLE or SIMPLE_PINHOLE", "Undistort the images first")
    return CameraFile(path, PinholeLens.of(camera))


def is_time(name: str) -> bool:
    """Whether a file stem is a timestamp in seconds; unlike a frame number it has a decimal point."""
    return _TIME.fullmatch(name) is not None


def times(paths: Sequence[Path]) -> Float[np.ndarray, "N"]:
    """Timestamps from file names, seconds; integers are accepted too."""
    return np.array([_time(path) for path in paths])


def by_number(paths: Sequence[Path]) -> dict[tuple[int, ...], Path]:
    """Files in natural order, 2 before 10, by all integers in their names, whatever their padding."""
    files: dict[tuple[int, ...], Path] = {}
    for index in natural_order([path.name for path in paths]):
        path = paths[index]
        key = tuple(int(digits) for digits in re.findall(r"\d+", path.stem))
        if not key:
            raise InputError(f"{path}: no number in its name", "names that count the frames", "Move other files away")
        if key in files:
            raise InputError(f"{files[key]} and {path.name} have the same number", "one file per frame", "Remove one")
        files[key] = path
    return files


def _time(path: Path) -> float:
    match = _TIME.fullmatch(path.stem)
    if match is not None:
        return float(match.group(1))
    if path.stem.isdecimal():
        return float(path.stem)
    raise InputError(
        f"{path}: its name is not a timestamp", "a name in seconds, for instance 1305031102.175304.png", "Rename it"
    )
