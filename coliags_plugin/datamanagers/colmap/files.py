"""Finding and reading a COLMAP sparse model (docs/layouts/colmap.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.colmap.binary import check_complete
from coliags_plugin.datamanagers.colmap.lens import ColmapLens
from coliags_plugin.geometry.poses import colmap as colmap_poses

if TYPE_CHECKING:
    import pycolmap

#: Folders that may hold a model; numbered sub-folders come before the folder itself.
_MODEL_FOLDERS = ("sparse", "colmap/sparse", ".")
_SUFFIXES = (".bin", ".txt")
_PARTS = ("cameras", "images", "points3D")
#: Panoramic camera models, which cannot be undistorted to a pinhole image.
_PANORAMIC = frozenset({"EQUIRECTANGULAR"})


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """A registered image and its observations.

    Attributes:
        name: Path relative to the folder of images.
        camera: COLMAP's camera ID.
        observed: Observed keypoints, pixels, centres at integers + 0.5. [K, 2]
        points: Their points: rows of :attr:`Model.positions`. [K]
    """

    name: str
    camera: int
    observed: Float[np.ndarray, "K 2"]
    points: Int[np.ndarray, "K"]


@dataclass(frozen=True, eq=False)
class Model:
    """A sparse model, in its own world frame and unit.

    Attributes:
        folder: Folder of the model.
        files: Its files.
        images: Registered images in natural order of their names, 2 before 10.
        camera_to_world: Their poses, OpenCV axes. [N, 4, 4]
        cameras: Cameras by COLMAP's ID.
        positions: Sparse points. [P, 3]
        colors: Their colours, RGB. [P, 3]
        track_lengths: Number of observations of each point. [P]
    """

    folder: Path
    files: tuple[Path, ...]
    images: Sequence[RegisteredImage]
    camera_to_world: Float[np.ndarray, "N 4 4"]
    cameras: Mapping[int, ColmapLens]
    positions: Float[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]
    track_lengths: Int[np.ndarray, "P"]

    @property
    def cameras_file(self) -> Path:
        """The file that holds the image sizes."""
        return self.files[0]


def find_models(scene: Path) -> list[Path]:
    """Model folders in the first parent folder that has any: ``sparse/0``, ``sparse/1``, ``sparse``, ..."""
    for name in _MODEL_FOLDERS:
        parent = scene / name
        numbered = [] if name == "." or not parent.is_dir() else [p for p in parent.iterdir() if p.name.isdecimal()]
        candidates = [*sorted(numbered, key=lambda path: int(path.name)), parent]
        if found := [path for path in candidates if _suffix(path) is not None]:
            return found
    return []


def read_model(folder: Path) -> Model:
    """Read a binary or text model; binary if both exist.

    Raises:
        InputError: The folder holds none; a file is damaged; poses are invalid (see
            :func:`coliags_plugin.geometry.poses.colmap.read`); or a camera cannot be undistorted to a pinhole.
    """
    suffix = _suffix(folder)
    if suffix is None:
        raise InputError(
            f"{folder} holds no COLMAP model",
            "a folder with cameras, images and points3D, all .bin or all .txt",
            "Give the model's folder with --set datamanager.model=FOLDER",
        )
    if suffix == ".bin":
        check_complete(folder)
    trajectory = colmap_poses.read(folder)
    files = tuple(folder / f"{part}{suffix}" for part in _PARTS)

    import pycolmap

    try:
        model = pycolmap.Reconstruction()
        (model.read_binary if suffix == ".bin" else model.read_text)(str(folder))
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
        reason = str(error).splitlines()[0].strip() if str(error).strip() else type(error).__name__
        raise InputError(
            f"{folder} cannot be read: {reason}",
            f"{', '.join(file.name for file in files)}, complete and of one model",
            "Copy all of them again",
        ) from error

    points = sorted(model.points3D.items())
    row = {number: index for index, (number, _) in enumerate(points)}
    by_name = {image.name: image for image in model.images.values()}
    images = []
    for name in trajectory.names or ():
        image = by_name[name]
        seen = image.get_observation_points2D()
        # COLMAP's reader does not check that observed points exist.
        if gone := [point.point3D_id for point in seen if point.point3D_id not in row]:
            raise InputError(
                f"{files[2]} has {len(row)} points, but not {gone[0]}, which {name} observes",
                "all points of the model",
                f"{files[2].name} is cut short or of another model: copy it again",
            )
        observed = np.array([(point.x(), point.y()) for point in seen], np.float64).reshape(-1, 2)
        rows = np.array([row[point.point3D_id] for point in seen], np.int64)
        images.append(RegisteredImage(name, image.camera_id, observed, rows))
    used = sorted({image.camera for image in images})
    return Model(
        folder,
        files,
        images,
        trajectory.camera_to_world,
        {number: _lens(model.cameras[number], files[0]) for number in used},
        np.array([point.xyz for _, point in points], np.float64).reshape(-1, 3),
        np.array([point.color for _, point in points], np.uint8).reshape(-1, 3),
        np.array([point.track.length() for _, point in points], np.int64),
    )


def sidecar_file(folder: Path, name: str, suffixes: Sequence[str]) -> Path | None:
    """The mask or depth file of an image: ``name.jpg.png``, as COLMAP names it, or ``name.png``; None if missing."""
    for suffix in suffixes:
        for path in (folder / f"{name}{suffix}", (folder / name).with_suffix(suffix)):
            if path.is_file():
                return path
    return None


def _suffix(folder: Path) -> str | None:
    for suffix in _SUFFIXES:
        if all((folder / f"{part}{suffix}").is_file() for part in _PARTS):
            return suffix
    return None


def _lens(camera: pycolmap.Camera, file: Path) -> ColmapLens:
    name, params = camera.model_name, tuple(float(value) for value in camera.params)
    if name in _PANORAMIC:
        raise InputError(
            f"{file}: camera {camera.camera_id} is {name}",
            "a camera whose images can be undistorted to a pinhole's",
            "Cut the panoramas into pinhole images first",
        )
    sizes = camera.width, camera.height, camera.focal_length_x, camera.focal_length_y
    if not np.all(np.isfinite(params)) or min(sizes) <= 0:
        raise InputError(
            f"{file}: camera {camera.camera_id} is {camera.width} x {camera.height} with {params}",
            "finite parameters, size and focal length above 0",
        )
    return ColmapLens(width=camera.width, height=camera.height, model=name, params=params)
