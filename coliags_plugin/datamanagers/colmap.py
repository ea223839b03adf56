"""Data manager for COLMAP sparse models: poses, cameras, points and sparse depth."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from pydantic import BaseModel, Field
from typing_extensions import override

from coliags_plugin.core import scene_files as reading
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.json_files import read_json, read_number
from coliags_plugin.core.scene_files import FACTORS, Unit, read_unit
from coliags_plugin.core.scenes import PointCloud, SparseDepth
from coliags_plugin.core.settings import read_validated
from coliags_plugin.datamanagers.file_formats import DepthFormat, InverseDepth, ScaledDepth
from coliags_plugin.datamanagers.recorded import InitialPoints, RecordedDataManager, Recording, SceneSettings
from coliags_plugin.datamanagers.shots import Rectification, Shot
from coliags_plugin.geometry.lenses.models import Array, MappedLens, PinholeLens
from coliags_plugin.geometry.poses import colmap as colmap_poses

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)


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
class SparseModel:
    """A sparse model, in its own world frame and unit: poses with OpenCV axes, RGB colours.

    Images are in natural order of their names, 2 before 10, and their ``points`` are rows of ``positions``; cameras by
    COLMAP's ID; ``track_lengths`` count observations.
    """

    folder: Path
    files: tuple[Path, ...]  # of cameras, images and points
    images: Sequence[colmap_poses.ColmapImage]
    camera_to_world: Float[np.ndarray, "N 4 4"]
    cameras: Mapping[int, ColmapLens]
    positions: Float[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]
    track_lengths: Int[np.ndarray, "P"]

    @property
    def names(self) -> list[str]:
        """Names of the images."""
        return [image.name for image in self.images]


def find_models(scene: Path, parts: tuple[str, ...] = _PARTS) -> list[Path]:
    """Folders of models, by their parts, in the first parent that has any: ``sparse/0``, ``sparse/1``, ``sparse``."""
    for name in _MODEL_FOLDERS:
        parent = scene / name
        numbered = [] if name == "." or not parent.is_dir() else [p for p in parent.iterdir() if p.name.isdecimal()]
        candidates = [*sorted(numbered, key=lambda path: int(path.name)), parent]
        if models := [path for path in candidates if colmap_poses.model_suffix(path, parts) is not None]:
            return models
    return []


def read_model(folder: Path) -> SparseModel:
    """Read a binary or text model; binary if both exist. It must be possible to undistort its images to a pinhole."""
    suffix = colmap_poses.model_suffix(folder, _PARTS)
    if suffix is None:
        raise InputError(
            f"{folder} holds no COLMAP model" + (f", but {reading.inventory(folder)}" if folder.is_dir() else ""),
            "a folder with cameras, images and points3D, all .bin or all .txt",
            "Restore what is missing, or give another model's folder with `datamanager.model=FOLDER`",
        )
    files = tuple(folder / f"{part}{suffix}" for part in _PARTS)
    registered = colmap_poses.ordered_images(files[1])
    cameras, points = colmap_poses.read_cameras(files[0]), colmap_poses.read_points(files[2])
    rows = {point.number: row for row, point in enumerate(points)}
    images = []
    for image in registered:
        if missing := [number for number in image.points.tolist() if number not in rows]:
            raise InputError(
                f"{files[2]} has {len(rows)} points, but not {missing[0]}, which {image.name} observes",
                "all points of the model",
                f"{files[2].name} is cut short or of another model: copy it again",
            )
        if image.camera not in cameras:
            raise InputError(
                f"{files[0]} has no camera {image.camera}, which {image.name} is of", "all cameras of the model"
            )
        images.append(replace(image, points=np.array([rows[number] for number in image.points.tolist()], np.int64)))
    used = sorted({image.camera for image in images})
    return SparseModel(
        folder,
        files,
        images,
        colmap_poses.camera_to_world(images),
        {number: _lens(cameras[number], files[0]) for number in used},
        np.array([point.position for point in points], np.float64).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.array([point.track_length for point in points], np.int64),
    )


def _lens(camera: colmap_poses.ColmapCamera, file: Path) -> ColmapLens:
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


# The record of a video's sub-maps beside its models (docs/poses.md 9.4)

#: Name of the file, in the scene's folder.
ATLAS_FILE = "atlas.json"


class AtlasStretch(BaseModel):
    """Frames, by number, of one model between two places at which few points are seen from both sides."""

    model: str  # folder of the model, relative to the scene
    unit: Unit  # of the model
    frames: list[int]


class AtlasJoin(BaseModel):
    """A place between two stretches."""

    after: int  # last frame before it
    joined: bool  # whether both sides are of one model
    reason: str


class LostFrame(BaseModel):
    """A frame without a pose."""

    frame: int
    reason: str


class AtlasRecord(BaseModel):
    """Models of the frames of a video, and the reasons why others have no pose."""

    frames: list[str]  # names of the images in order: frames are numbered from 0
    submaps: list[AtlasStretch]
    joins: list[AtlasJoin]
    lost: list[LostFrame]


def read_atlas(scene: Path) -> AtlasRecord | None:
    """Read a scene's ``atlas.json``; None if it has none."""
    file = scene / ATLAS_FILE
    if not file.is_file():
        return None
    return read_validated(AtlasRecord, file, "what `coliags poses sfm` wrote")


def model_unit(scene: Path, model: Path, atlas: AtlasRecord | None) -> Unit:
    """Unit of length of one of a scene's models: from its atlas if that lists the model, else from ``unit.txt``.

    COLMAP's own models are of an arbitrary scale: unknown where neither states it.
    """
    units = {} if atlas is None else {scene / stretch.model: stretch.unit for stretch in atlas.submaps}
    return units.get(model) or read_unit(scene)


_DEPTH_SUFFIXES = (".png", ".npy", ".tiff", ".tif")
#: Beside the model: scale and offset of each image's inverse depth, as the reference code of 3DGS stores it.
_DEPTH_PARAMS = "depth_params.json"


class ColmapSettings(SceneSettings):
    """Options of the ``colmap`` data manager."""

    initial_points: InitialPoints = Field(
        "data",
        description="Initial points: 'data': the model's sparse points; 'depth': fused from depths/ if present; "
        "'file': points_file.",
    )
    model: str | None = Field(
        None,
        description="Folder of the sparse model, relative to the scene. None: sparse/0, sparse, colmap/sparse/0, "
        "colmap/sparse or the scene's folder itself, the first that exists.",
    )
    images_folder: str = Field("images", description="Folder that the model's image names are relative to.")
    scale: float = Field(
        1.0,
        gt=0.0,
        description="Factor on lengths of the model, whose scale is arbitrary: on poses, points and sparse depth.",
    )
    max_reprojection_error: float = Field(
        2.0,
        gt=0.0,
        description="Largest reprojection error of an observation that gives sparse depth, pixels of the stored image.",
    )
    min_track_length: int = Field(
        3, ge=2, description="Least track length of points that give sparse depth; all points are initial points."
    )
    depth_unit: float | None = Field(
        None,
        gt=0.0,
        description="Millimetres per stored unit of the files in depths/; units of the model where that is unknown. "
        "None: 1, but asked for where the unit is unknown.",
    )


class ColmapDataManager(RecordedDataManager):
    """Reads images with a COLMAP sparse model (docs/layouts/colmap.md)."""

    Settings = ColmapSettings

    settings: ColmapSettings
    name = "colmap"
    masks_at = "masks/NAME.png"

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        # A nerfstudio scene may contain its COLMAP model, but its poses are in transforms.json.
        models = [] if (path / "transforms.json").is_file() else find_models(path)
        return f"a sparse model in {models[0].relative_to(path).as_posix()}" if models else None

    @classmethod
    def refuse_nearly(cls, path: Path) -> None:
        """Raise InputError for a COLMAP model that lacks cameras, images or points3D."""
        for part in _PARTS:
            for folder in find_models(path, tuple(other for other in _PARTS if other != part)):
                read_model(folder)

    @override
    def open(self, path: Path) -> Recording:
        settings = self.settings
        if not path.is_dir():
            raise InputError(f"no folder {path}", "a folder with images/ and sparse/0", "Check the path")
        model = read_model(self._model_folder(path))
        paths = _image_paths(path / user_path(settings.images_folder), model, settings.outside_files)
        masks = _masks(path, model)
        atlas = read_atlas(path)
        unit = settings.unit or model_unit(path, model.folder, atlas)
        depths, forms, params = self._depths(path, model, unit)
        rectifications = {
            number: self.rectification_of(
                PinholeLens.of(lens.pinhole) if lens.model in PINHOLES else lens, model.files[0]
            )
            for number, lens in model.cameras.items()
        }
        others = reading.unposed_images(paths, (*masks, *depths))
        if atlas is None:  # else it says why images have no pose, or which other model has one
            reading.warn_of_unposed(model.files[1], others)
        names = reading.short_names(model.names)
        parts = zip(model.images, names, paths, model.camera_to_world, depths, forms, masks, strict=True)
        shots, misplaced = [], 0
        for image, name, file, pose, depth, form, mask in parts:
            camera_to_world, rectification = pose.copy(), rectifications[image.camera]
            camera_to_world[:3, 3] *= settings.scale
            sparse, off = self._sparse_depth(model, image, camera_to_world, rectification)
            misplaced += off
            shots.append(Shot(name, file, rectification, camera_to_world, depth, form, mask, sparse))
        kinds = sorted({lens.model for lens in model.cameras.values()})
        facts: dict[str, Any] = {
            "layout": "colmap",
            "model": str(model.folder),
            "unit": unit,
            "lens": ", ".join(kinds),
            "observations": sum(len(image.points) for image in model.images),
            "misplaced_observations": misplaced,
        }

        def points(_: Path) -> PointCloud:
            positions = (model.positions * settings.scale).astype(np.float32)
            return PointCloud(torch.from_numpy(positions), torch.from_numpy(model.colors))

        return Recording(
            folder=path,
            kind=f"COLMAP model {model.folder}, {len(model.positions)} points, cameras {', '.join(kinds)}",
            shots=shots,
            facts=facts,
            described_by=(*model.files, params),
            points_source=model.files[-1],
            read_points=points if len(model.positions) else None,
            is_complete=not others,
            made_from={"points": [index for index, image in enumerate(model.images) if len(image.points)]},
        )

    def _model_folder(self, path: Path) -> Path:
        if self.settings.model is not None:
            return path / self.settings.model
        models = find_models(path)
        if not models:
            raise InputError(
                f"{path} holds no COLMAP model",
                "cameras, images and points3D, all .bin or all .txt, in sparse/0, sparse, colmap/sparse/0, "
                "colmap/sparse or the folder itself",
                "Check the path, or choose one with `datamanager.model=FOLDER`",
            )
        if len(models) > 1:
            others = ", ".join(folder.relative_to(path).as_posix() for folder in models[1:])
            log.warning(
                "reading %s; there are further models, which `datamanager.model=FOLDER` chooses: %s",
                models[0],
                others,
            )
        return models[0]

    def _depths(
        self, path: Path, model: SparseModel, unit: Unit
    ) -> tuple[Sequence[Path | None], Sequence[DepthFormat | None], Path | None]:
        """Depth files of all images or of none, their formats, and the file of scales and offsets of inverse depth.

        Without such a file, depth is in the unit that the options or the scene state.
        """
        folder, params, depth_unit = path / "depths", model.folder / _DEPTH_PARAMS, self.settings.depth_unit
        is_inverse = params.is_file()
        if not folder.is_dir():
            if is_inverse:
                log.warning("%s is not used, as there is no %s", params, folder)
            return [None] * len(model.images), [None] * len(model.images), None
        suffixes = (".png",) if is_inverse else _DEPTH_SUFFIXES
        depths = reading.sidecar_files(folder, model.names, suffixes)
        files = reading.for_every(depths, folder, f"a file NAME{', NAME'.join(suffixes)}")
        if is_inverse and depth_unit is not None:
            raise InputError(
                f"the option depth_unit = {depth_unit:g}, but {params}, by which depths/ holds inverse depth",
                "one of the two",
                "Leave the option out, or move the file away",
            )
        if is_inverse:
            return files, _inverse_depths(params, model, self.settings.scale), params
        if depth_unit is None and unit == "unknown":
            raise InputError(
                f"{path} has depths/, but the model's unit of length and the value of a step of depth are not given",
                f"the option depth_unit, scene lengths per step; or {_DEPTH_PARAMS} beside it, for inverse depth",
                "For millimetres in a model in metres `datamanager.depth_unit=0.001`, or unit.txt with m, "
                "which means the same; move depths/ away if it is relative",
            )
        if depth_unit is None:
            log.info("%s/depths is read at 1 mm a step; `datamanager.depth_unit=MM` changes that", path)
        return files, [ScaledDepth((depth_unit or 1.0) / FACTORS[unit])] * len(files), None

    def _sparse_depth(
        self,
        model: SparseModel,
        image: colmap_poses.ColmapImage,
        camera_to_world: np.ndarray,
        rectification: Rectification,
    ) -> tuple[SparseDepth | None, int]:
        """z-depth of the image's points at their projections (not at the observed keypoints).

        Also the number of observations far from these, or of points behind the camera.
        """
        settings, lens = self.settings, model.cameras[image.camera]
        points = model.positions[image.points] * settings.scale
        local = (points - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.linalg.norm(lens.project(local) - image.observed, axis=1)
            k = rectification.pinhole
            pixels = local[:, :2] / local[:, 2:] * (k.fx, k.fy) + (k.cx, k.cy)
            is_used = (error <= settings.max_reprojection_error) & (local[:, 2] > 0.0)
            misplaced = int((~is_used).sum())
            is_used &= (pixels >= 0.0).all(axis=1) & (pixels[:, 0] < k.width) & (pixels[:, 1] < k.height)
        is_used &= model.track_lengths[image.points] >= settings.min_track_length
        # One depth per point, even if the image observes it twice.
        _, first = np.unique(image.points[is_used], return_index=True)
        rows = np.flatnonzero(is_used)[np.sort(first)]
        if not len(rows):
            return None, misplaced
        pixels, depth = (torch.from_numpy(values[rows].astype(np.float32)) for values in (pixels, local[:, 2]))
        return SparseDepth(pixels, depth), misplaced


def _image_paths(folder: Path, model: SparseModel, outside: bool) -> list[Path]:
    if not folder.is_dir():
        raise InputError(
            f"no folder {folder}",
            "the images that the model was made from",
            "Name it with `datamanager.images_folder=FOLDER`",
        )
    paths = {name: reading.named_file(folder, name, str(model.folder), outside) for name in model.names}
    return reading.for_every(
        {name: path if path.is_file() else None for name, path in paths.items()}, folder, "an image"
    )


def _masks(scene: Path, model: SparseModel) -> list[Path | None]:
    folder = reading.one_folder(scene, reading.MASK_FOLDERS)
    if folder is None:
        return [None] * len(model.images)
    masks = [*reading.sidecar_files(folder, model.names, reading.MASK_SUFFIXES).values()]
    if any(folder.iterdir()) and not any(masks):
        raise InputError(
            f"{folder} holds {reading.inventory(folder)}, and no mask of any image of {model.folder}",
            f"masks named like the images, {model.images[0].name}.png for instance",
            "Rename them, or move the folder away",
        )
    return masks


def _inverse_depths(file: Path, model: SparseModel, size: float) -> list[InverseDepth]:
    """Formats of depth of all images by a ``depth_params.json``; ``size``: scene units per unit of the model."""
    expected = "scale and offset of every image of the model, by its name without suffix"
    content = read_json(file, expected, "Make the file again, or move it away")
    forms = []
    for image in model.images:
        key = image.name.rpartition(".")[0] or image.name
        entry = content.get(key) if isinstance(content, dict) else None
        if not isinstance(entry, dict):
            raise InputError(f"{file} has no {key}", expected, "Make the file again, for this model")
        scale, offset = (read_number(entry, what, f"{file}, {key}", "a finite number") for what in ("scale", "offset"))
        forms.append(InverseDepth(size, scale=scale, offset=offset))
    if unscaled := [image.name for image, form in zip(model.images, forms, strict=True) if form.scale <= 0.0]:
        named = reading.first_few(unscaled)
        log.warning("%s: %d images have no depth, as their scale is not above 0: %s", file, len(unscaled), named)
    return forms
