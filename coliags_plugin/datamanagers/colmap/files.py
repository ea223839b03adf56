"""Finding and reading a COLMAP sparse model (docs/layouts/colmap.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.lenses.models import Array
from coliags_plugin.geometry.lenses.tabulated import MappedLens
from coliags_plugin.geometry.poses import colmap as colmap_poses
from coliags_plugin.geometry.poses import colmap_files

if TYPE_CHECKING:
    import pycolmap

#: Camera models without distortion.
PINHOLES = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})
#: Folders that may hold a model; numbered sub-folders come before the folder itself.
_MODEL_FOLDERS = ("sparse", "colmap/sparse", ".")
_PARTS = ("cameras", "images", "points3D")
#: Panoramic camera models, which cannot be undistorted to a pinhole image.
_PANORAMIC = frozenset({"EQUIRECTANGULAR"})


@dataclass(frozen=True, kw_only=True)
class ColmapLens(MappedLens):
    """A camera of a COLMAP model, for instance ``OPENCV_FISHEYE``, projected by pycolmap.

    ``params`` are as COLMAP orders them; pixels, centres at integers + 0.5.
    """

    model: str
    params: tuple[float, ...]

    @cached_property
    def _camera(self) -> pycolmap.Camera:
        import pycolmap

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Along columns and rows, pixels."""
        return self._camera.focal_length_x, self._camera.focal_length_y

    @property
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        return *self.focal_lengths, self._camera.principal_point_x, self._camera.principal_point_y

    def _bent(self, tangents: Array) -> Array:
        points = np.concatenate([tangents, np.ones((len(tangents), 1))], axis=1)
        return np.asarray(self._camera.img_from_cam(points), np.float64)


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """A registered image, its name relative to the folder of images, and COLMAP's ID of its camera.

    ``observed`` are keypoints, pixels, centres at integers + 0.5; ``points`` their rows of
    :attr:`SparseModel.positions`.
    """

    name: str
    camera: int
    observed: Float[np.ndarray, "K 2"]
    points: Int[np.ndarray, "K"]


@dataclass(frozen=True, eq=False)
class SparseModel:
    """A sparse model, in its own world frame and unit: poses with OpenCV axes, RGB colours.

    Images are in natural order of their names, 2 before 10; cameras by COLMAP's ID; ``track_lengths`` count
    observations.
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
        if found := [path for path in candidates if colmap_files.model_suffix(path, _PARTS) is not None]:
            return found
    return []


def read_model(folder: Path) -> SparseModel:
    """Read a binary or text model; binary if both exist. It must be possible to undistort its images to a pinhole."""
    suffix = colmap_files.model_suffix(folder, _PARTS)
    if suffix is None:
        raise InputError(
            f"{folder} holds no COLMAP model",
            "a folder with cameras, images and points3D, all .bin or all .txt",
            "Give the model's folder with --set datamanager.model=FOLDER",
        )
    files = tuple(folder / f"{part}{suffix}" for part in _PARTS)
    trajectory = colmap_poses.read(folder)
    cameras, points = colmap_files.read_cameras(files[0]), colmap_files.read_points(files[2])
    rows = {point.number: row for row, point in enumerate(points)}
    by_name = {image.name: image for image in colmap_files.read_images(files[1])}
    images = []
    for name in trajectory.names or ():
        image = by_name[name]
        if missing := [number for number in image.points.tolist() if number not in rows]:
            raise InputError(
                f"{files[2]} has {len(rows)} points, but not {missing[0]}, which {name} observes",
                "all points of the model",
                f"{files[2].name} is cut short or of another model: copy it again",
            )
        if image.camera not in cameras:
            raise InputError(f"{files[0]} has no camera {image.camera}, which {name} is of", "all cameras of the model")
        observed = np.array([rows[number] for number in image.points.tolist()], np.int64)
        images.append(RegisteredImage(name, image.camera, image.observed, observed))
    used = sorted({image.camera for image in images})
    return SparseModel(
        folder,
        files,
        images,
        trajectory.camera_to_world,
        {number: _lens(cameras[number], files[0]) for number in used},
        np.array([point.position for point in points], np.float64).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.array([point.track_length for point in points], np.int64),
    )


def sidecar_file(folder: Path, name: str, suffixes: Sequence[str]) -> Path | None:
    """The mask or depth file of an image: ``name.jpg.png``, as COLMAP names it, or ``name.png``; None if missing."""
    for suffix in suffixes:
        for path in (folder / f"{name}{suffix}", (folder / name).with_suffix(suffix)):
            if path.is_file():
                return path
    return None


def _lens(camera: colmap_files.ColmapCamera, file: Path) -> ColmapLens:
    lens = ColmapLens(width=camera.width, height=camera.height, model=camera.model, params=camera.params)
    if camera.model in _PANORAMIC:
        raise InputError(
            f"{file}: camera {camera.number} is {camera.model}",
            "a camera whose images can be undistorted to a pinhole's",
            "Cut the panoramas into pinhole images first",
        )
    finite = np.all(np.isfinite(camera.params))
    if not finite or min(camera.width, camera.height, *lens.focal_lengths) <= 0:
        raise InputError(
            f"{file}: camera {camera.number} is {camera.width} x {camera.height} with {camera.params}",
            "finite parameters, size and focal length above 0",
        )
    return lens
