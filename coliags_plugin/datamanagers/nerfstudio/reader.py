"""Data manager for ``transforms.json`` of nerfstudio, instant-ngp and Blender's NeRF scenes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.nerfstudio.files import FILE, PixelCenters, Transforms
from coliags_plugin.datamanagers.reading.depth_formats import depth_format
from coliags_plugin.datamanagers.reading.files import short_names, unposed_images, warn_of_unposed
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import Recording, Shot, fingerprint
from coliags_plugin.datamanagers.rectification import rectifications
from coliags_plugin.datamanagers.scene_settings import POINTS_FILE, SceneSettings
from coliags_plugin.datamanagers.seen_masks import find_seen_masks
from coliags_plugin.datamanagers.units import FACTORS, Unit, printed_unit
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.poses import nerfstudio as nerfstudio_poses

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
        "millimetre; of a world of unknown unit, one of its units.",
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
    unit = "unknown"

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        if not (path / FILE).is_file() or any((path / name).exists() for name in _ROTATECOLON):
            return None
        return FILE

    def open(self, path: Path) -> Recording:
        """See :class:`RecordedDataManager`."""
        settings, file = self.settings, path / FILE
        if not file.is_file():
            raise InputError(f"no file {file}", "a folder with a transforms.json", "Check the path")
        trajectory = nerfstudio_poses.read(file)
        transforms, names = Transforms(file, settings.outside_files), trajectory.names_or_numbers()
        entries = transforms.entries(names, settings.pixel_centers)
        camera_to_world = trajectory.camera_to_world.copy()
        camera_to_world[:, :3, 3] *= settings.scale
        unit = self.stated_unit(path)
        depth_unit = self._depth_unit(transforms, unit)
        lenses = {entry.camera: entry.camera for entry in entries}
        rectification_of = rectifications(lenses, file, self.working_size, settings.focal_scale)
        images = [entry.image for entry in entries]
        others = [path for entry in entries for path in (entry.depth, entry.mask, entry.confidence)]
        unposed = unposed_images(images, others)
        warn_of_unposed(file, unposed)
        seen = find_seen_masks(path / "truth", len(images), complete=not unposed)
        shots = [
            Shot(
                short,
                entry.image,
                rectification_of[entry.camera],
                pose,
                entry.depth,
                None if entry.depth is None else depth_format(entry.depth, depth_unit),
                entry.mask,
                seen.get(index),
                confidence=entry.confidence,
            )
            for index, (short, entry, pose) in enumerate(zip(short_names(names), entries, camera_to_world, strict=True))
        ]
        kinds = sorted({type(lens).__name__ for lens in lenses})
        bent = not all(isinstance(lens, PinholeLens) for lens in lenses)
        facts: dict[str, Any] = {
            "layout": "nerfstudio",
            "lens": ", ".join(kinds),
            "focal_scale": settings.focal_scale if bent else None,
            "cameras": len(rectification_of),
            **next(iter(rectification_of.values())).facts(),
            "scale": settings.scale,
            "depth_unit": depth_unit if shots[0].depth is not None else None,
            "depth_is_estimated": shots[0].confidence is not None,
            "pixel_centers_in_file": settings.pixel_centers,
            "pose_convention": {
                "stored_as": trajectory.stored_as,
                "remarks": [remark for remark in trajectory.remarks if not remark.startswith("no intrinsics")],
            },
            "masks": sum(entry.mask is not None for entry in entries),
        }
        own_points, source = self._own_points(path, transforms)
        return Recording(
            kind=f"nerfstudio, {trajectory.summary(printed_unit(unit))}",
            shots=shots,
            facts=facts,
            fingerprint=fingerprint(path, [*images, *others], [file]),
            own_split=transforms.split(names),
            made_from=transforms.made_from(names),
            own_points=own_points,
            points_source=source,
        )

    def _depth_unit(self, transforms: Transforms, unit: Unit) -> float:
        """World units per stored depth unit."""
        for factor in (self.settings.depth_unit_scale_factor, transforms.depth_unit()):
            if factor is not None:
                return factor * self.settings.scale
        return 1.0 / FACTORS[unit]

    def _own_points(self, path: Path, transforms: Transforms) -> tuple[Callable[[], PointCloud] | None, Path | None]:
        """Points of ``ply_file_path`` (in the file's world), or else of ``points3D.ply`` (in the scene's world)."""
        file = transforms.points_file()
        if file is None:
            beside = path / POINTS_FILE
            return ((lambda: load_points(beside)), beside) if beside.is_file() else (None, None)

        def points() -> PointCloud:
            cloud = load_points(file)
            positions = transforms.undo_applied_transform(cloud.positions.double().numpy()) * self.settings.scale
            return PointCloud(torch.from_numpy(positions).float(), cloud.colors)

        return points, file
