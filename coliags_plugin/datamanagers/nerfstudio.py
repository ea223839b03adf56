"""Reads and writes ``transforms.json`` of nerfstudio, instant-ngp and Blender (docs/layouts/nerfstudio.md)."""

from __future__ import annotations

import logging
import posixpath
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from pydantic import Field
from typing_extensions import override

from coliags_plugin.core import scene_files as reading
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image, write_mask
from coliags_plugin.core.json_files import read_number
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.scene_files import FACTORS, Unit, printed_unit
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.file_formats import PixelCenters, Transforms, scaled_depth, size_of
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.recorded import POINTS_FILE, RecordedDataManager, Recording, SceneSettings
from coliags_plugin.datamanagers.shots import Shot
from coliags_plugin.geometry.poses.trajectory import FLIP_Y_AND_Z

log = logging.getLogger(__name__)

FILE = "transforms.json"
#: Key of the list of frames that estimated depth was made from.
ESTIMATED_FROM = "depth_estimated_from"
#: World units per stored depth unit where nothing says it: millimetres in a world of metres.
_DEPTH_STEP = 1e-3
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


class NerfstudioTransforms(Transforms):
    """Content of a ``transforms.json`` by nerfstudio's keys, and instant-ngp's of depth."""

    def images(self) -> list[Path]:
        """The images of all frames."""
        paths = {}
        for name in self.names:
            candidates = (self.named(f"{name}{suffix}") for suffix in ("", *_IMAGE_SUFFIXES))
            paths[name] = next((path for path in candidates if path.is_file()), None)
        return reading.for_every(paths, self.path, f"an image in {self.path.parent}")

    def masks(self) -> Sequence[Path | None]:
        """The masks of any of the frames; warns of other keys that may mean masks."""
        others = {key for frame in self.frames for key in frame} - {"mask_path"} | set(self.content)
        if ignored := sorted(key for key in others if "mask" in key.lower()):
            log.warning("%s: masks are the mask_path of a frame; ignored: %s", self.path, ", ".join(ignored))
        return self.files("mask_path", for_every=False)

    def points_file(self) -> Path | None:
        """The file of ``ply_file_path``; None if there is none."""
        name = self.content.get("ply_file_path")
        if name is None:
            return None
        return reading.required_file(self.named(str(name)), f"the point cloud of ply_file_path in {self.path}")

    def split(self) -> dict[str, list[int]] | None:
        """Indices of training and test frames; None if the file has no split.

        Test frames are those of ``test_filenames`` or, if empty, of ``val_filenames``.
        """
        listed = {part: self.content.get(f"{part}_filenames") for part in ("train", "val", "test")}
        if not listed["train"]:
            return None
        test = "test" if listed["test"] else "val"
        chosen = {
            "train": self._indices("train_filenames", listed["train"]),
            "test": self._indices(f"{test}_filenames", listed[test] or []),
        }
        if both := set(chosen["train"]) & set(chosen["test"]):
            name = self.names[min(both)]
            raise InputError(f"{self.path}: {name} is in train_filenames and {test}_filenames", "one of the two")
        return chosen

    def made_from(self) -> dict[str, list[int]]:
        """Indices of the frames that estimated depth was made from, if the file tells."""
        listed = self.content.get(ESTIMATED_FROM)
        return {} if listed is None else {"depth": self._indices(ESTIMATED_FROM, listed)}

    def depths(self, option: float | None) -> tuple[Sequence[Path | None], float | None]:
        """Depth files of all frames or of none, and world units before applied_scale per stored unit; None: not said.

        The keys of instant-ngp are read where no frame has nerfstudio's. ``option``: an option that replaces the unit.
        """
        content, named = self.content, {key for frame in self.frames for key, value in frame.items() if value}
        files = self.files("depth_file_path", for_every=True)
        if not any(files) and "depth_path" in named and content.get("enable_depth_loading", True):
            # As instant-ngp has it, there is no depth without a scale.
            step = read_number({"integer_depth_scale": 0, **content}, "integer_depth_scale", self.path)
            step /= float(content.get("applied_scale", 1.0))  # which it knows nothing of
            if (step := option or step) > 0.0:
                return self.files("depth_path", for_every=True), step
        if not any(files) and (others := sorted(key for key in named if "depth" in key)):
            expected = "depth_file_path, or depth_path with integer_depth_scale and without enable_depth_loading false"
            log.warning("%s: no depth is read from %s of its frames, only from %s", self.path, others[0], expected)
        if option is None and "depth_unit_scale_factor" in content:
            option = read_number(content, "depth_unit_scale_factor", self.path, "a number above 0", above=0.0)
        return files, option

    def _indices(self, key: str, listed: Any) -> list[int]:
        index_of = {_normal(name): index for index, name in enumerate(self.names)}
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{self.path}: {key} is not a list of names", "file_paths of frames")
        unknown = [name for name in listed if _normal(name) not in index_of]
        if unknown:
            hint = did_you_mean(unknown[0], index_of)
            raise InputError(f"{self.path}: {key} names {unknown[0]}", "a file_path of a frame", hint)
        return sorted({index_of[_normal(name)] for name in listed})


def _normal(name: str) -> str:
    """A path without repeated or relative parts, with slashes."""
    return posixpath.normpath(name.replace("\\", "/"))


#: Files that identify RotateColon instead, whose images are named by number and whose depth is scaled.
_ROTATECOLON = ("train_views", "transforms_test.json")


class NerfstudioSettings(SceneSettings):
    """Options of the ``nerfstudio`` data manager."""

    scale: float = Field(
        1.0,
        gt=0.0,
        description="Factor on lengths of poses, points and depth, for a file whose unit has no name.",
    )
    depth_unit_scale_factor: float | None = Field(
        None,
        gt=0.0,
        description="World units before applied_scale per stored depth unit. None: the file's value of this name, or a "
        "millimetre; of a world of unknown unit, 0.001 of its units.",
    )
    pixel_centers: PixelCenters = Field(
        "half",
        description="Where the file's cx and cy count pixel centres: 'half': at integers + 0.5, as nerfstudio and "
        "COLMAP do; 'integer': at integers, as OpenCV's calibration gives them.",
    )


class NerfstudioDataManager(RecordedDataManager):
    """Reads nerfstudio's data format (docs/layouts/nerfstudio.md)."""

    Settings = NerfstudioSettings

    settings: NerfstudioSettings
    name = "nerfstudio"
    masks_at = "mask_path of each frame"
    unit = "unknown"

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        if not (path / FILE).is_file() or any((path / name).exists() for name in _ROTATECOLON):
            return None
        return FILE

    @classmethod
    def refuse_nearly(cls, path: Path) -> None:
        """Raise InputError for the layout of Blender's NeRF scenes: transforms_train.json, transforms_test.json."""
        if parts := [part for part in ("train", "val", "test") if (path / f"transforms_{part}.json").is_file()]:
            raise InputError(
                f"{path} is of the layout of Blender's NeRF scenes: {', '.join(f'transforms_{p}.json' for p in parts)}",
                "all frames in one transforms.json",
                "Join the files' frames; train_filenames and test_filenames there list the file_path of each part",
            )

    @override
    def open(self, path: Path) -> Recording:
        settings, file = self.settings, path / FILE
        reading.required_file(file, "a folder with a transforms.json", "Check the path")
        transforms = NerfstudioTransforms(file, settings.outside_files)
        trajectory = transforms.trajectory
        images, masks = transforms.images(), transforms.masks()
        depths, depth_step = transforms.depths(settings.depth_unit_scale_factor)
        confidences = transforms.files("confidence_file_path", for_every=True)
        # Without a size in the file, all images must have the size of the first.
        lenses = transforms.lenses(settings.pixel_centers, cache(lambda: size_of(images[0])))
        camera_to_world = trajectory.camera_to_world.copy()
        camera_to_world[:, :3, 3] *= settings.scale
        unit = self.stated_unit(path)
        depth_unit = self._depth_unit(depth_step, unit, file if any(depths) else None)
        rectifications = {lens: self.rectification_of(lens, file) for lens in dict.fromkeys(lenses)}
        others = [path for of_frame in zip(depths, masks, confidences, strict=True) for path in of_frame]
        unposed = reading.unposed_images(images, others)
        reading.warn_of_unposed(file, unposed)
        names = reading.short_names(transforms.names)
        forms = [None if depth is None else scaled_depth(depth, depth_unit) for depth in depths]
        parts = zip(names, images, lenses, camera_to_world, depths, forms, masks, confidences, strict=True)
        shots = [
            Shot(name, image, rectifications[lens], pose, depth, form, mask, confidence=confidence)
            for name, image, lens, pose, depth, form, mask, confidence in parts
        ]
        kinds = sorted({type(lens).__name__ for lens in lenses})
        facts: dict[str, Any] = {
            "layout": "nerfstudio",
            "lens": ", ".join(kinds),
            "depth_unit": depth_unit if shots[0].depth is not None else None,
            "pose_convention": {
                "stored_as": trajectory.stored_as,
                "remarks": [remark for remark in trajectory.remarks if not remark.startswith("no ")],
            },
        }
        source = transforms.points_file()
        return Recording(
            folder=path,
            kind=f"nerfstudio, {trajectory.summary(printed_unit(unit))}",
            shots=shots,
            facts=facts,
            described_by=(file,),
            own_split=transforms.split(),
            made_from=transforms.made_from(),
            points_source=source or path / POINTS_FILE,
            read_points=load_points if source is None else partial(self._points, transforms),
            is_complete=not unposed,
        )

    def _depth_unit(self, step: float | None, unit: Unit, file: Path | None) -> float:
        """World units per stored depth unit, which is ``step`` before ``scale`` if anything says so.

        The ``file``, if it names depth, is warned of where the value is only the format's default.
        """
        if step is None and unit != "unknown":
            return 1.0 / FACTORS[unit]
        if step is None and file is not None:
            log.warning(
                "%s has no depth_unit_scale_factor: depth is read as %g units a step, the format's default. If that is "
                "wrong: `datamanager.depth_unit_scale_factor=UNITS`, or `datamanager.unit=mm` of a world in mm",
                file,
                _DEPTH_STEP,
            )
        return (step or _DEPTH_STEP) * self.settings.scale

    def _points(self, transforms: NerfstudioTransforms, file: Path) -> PointCloud:
        """Points of ``ply_file_path`` in the world of the poses, which nerfstudio has transformed."""
        cloud = load_points(file)
        content = transforms.content
        applied = np.array(content.get("applied_transform", np.eye(4)), np.float64)[:3]
        unscaled = cloud.positions.double().numpy() / float(content.get("applied_scale", 1.0)) - applied[:, 3]
        positions = unscaled @ applied[:, :3] * self.settings.scale
        return PointCloud(torch.from_numpy(positions).float(), cloud.colors)


_POINTS = "points.ply"


class EstimatedSceneWriter:
    """Writes the frames of a scene one by one, then ``transforms.json`` and the points.

    ``depth_unit`` is in scene units per 16-bit step.
    """

    def __init__(self, folder: Path, depth_unit: float) -> None:
        self.folder, self.depth_unit = folder, depth_unit
        self._frames: list[dict[str, Any]] = []

    def write_frame(
        self,
        name: str,  # unique; the stem of its files
        camera: Camera,  # pinhole of the image, posed
        image: UInt8[np.ndarray, "H W 3"],  # RGB
        mask: Bool[np.ndarray, "H W"] | None,  # False where a pixel is to be ignored; None: nowhere
        depth: Float[np.ndarray, "H W"],  # z-depth, scene units; not positive where unknown
        confidence: Float[np.ndarray, "H W"],  # 0 to 1
    ) -> None:
        """Write the files of a frame."""
        file = f"{name}.png"
        steps = np.clip(np.rint(depth / self.depth_unit), 0, 65535).astype(np.uint16)
        write_image(self.folder / "images" / file, image)
        grey = np.rint(255.0 * confidence).astype(np.uint8)
        for part, values in (("depth", steps), ("confidence", grey)):
            if mask is not None:
                values[~mask] = 0
            write_image(self.folder / part / file, values)
        entry: dict[str, Any] = {
            "file_path": f"images/{file}",
            "depth_file_path": f"depth/{file}",
            "confidence_file_path": f"confidence/{file}",
        }
        if mask is not None:
            write_mask(self.folder / "masks" / file, mask)
            entry["mask_path"] = f"masks/{file}"
        k = camera.intrinsics
        entry |= {"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height}
        entry["transform_matrix"] = (camera.camera_to_world.cpu().double().numpy() @ FLIP_Y_AND_Z).tolist()
        self._frames.append(entry)

    def finish(
        self,
        positions: Float[np.ndarray, "N 3"],
        colors: UInt8[np.ndarray, "N 3"],
        sources: Sequence[str],
        split: tuple[Sequence[str], Sequence[str]] | None,
    ) -> None:
        """Write the initial points and ``transforms.json``.

        ``sources`` names the frames that depth and points were made from, ``split`` training and test frames.
        """
        write_ply(self.folder / _POINTS, point_properties(positions, colors))
        listed = {ESTIMATED_FROM: sources}
        if split is not None:
            listed |= {"train_filenames": split[0], "test_filenames": split[1]}
        lists = {key: [f"images/{name}.png" for name in names] for key, names in listed.items()}
        content = {
            "camera_model": "OPENCV",
            "depth_unit_scale_factor": self.depth_unit,
            "ply_file_path": _POINTS,
            **lists,
            "frames": self._frames,
        }
        write_json(self.folder / "transforms.json", content)
