"""Data manager for TUM's RGB-D layout, as read and written by SLAM systems and Gaussian Pancakes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.reading.depth_formats import DepthSteps
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from coliags_plugin.datamanagers.recording import Recording, Shot, fingerprint
from coliags_plugin.datamanagers.rectification import rectifications
from coliags_plugin.datamanagers.rgbd import files
from coliags_plugin.datamanagers.scene_settings import POINTS_FILE, SceneSettings
from coliags_plugin.datamanagers.seen_masks import find_seen_masks
from coliags_plugin.datamanagers.units import printed_unit
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.association import nearest_in_time
from coliags_plugin.geometry.poses.trajectory import Trajectory

log = logging.getLogger(__name__)


class RGBDSettings(SceneSettings):
    """Options of the ``rgbd`` data manager."""

    depth: Literal["metric", "none"] = Field(
        "metric",
        description="'metric': depth files hold linearly scaled z-depth. 'none': ignore them, for relative depth, as "
        "Gaussian Pancakes' may be.",
    )
    depth_scale: float | None = Field(
        None,
        gt=0.0,
        description="Depth steps per scene unit, the unit of the trajectory. None: from the camera's file. TUM's files "
        "have 5000 per metre.",
    )
    association: Literal["auto", "time", "order"] = Field(
        "auto",
        description="How images, poses and depth are associated: 'time': by the timestamps in image names; 'order': "
        "line n of the trajectory belongs to image n; 'auto': time, if names have a decimal point.",
    )
    max_time_difference: float = Field(
        0.02, ge=0.0, description="Association by time: largest difference, seconds. 0.02 is TUM's value."
    )
    trajectory: str | None = Field(
        None, description="The trajectory file, if there are several; relative to the scene folder, or absolute."
    )


@dataclass(frozen=True)
class _Frames:
    """Associated image files, depth files and pose indices, in video order."""

    images: Sequence[Path]
    depths: Sequence[Path | None]
    poses: Sequence[int]
    facts: dict[str, Any]


class RGBDDataManager(RecordedDataManager):
    """Reads images, depth and a TUM trajectory (docs/layouts/rgbd.md)."""

    Settings = RGBDSettings

    settings: RGBDSettings
    name = "rgbd"
    unit = "unknown"
    #: Whether this format's camera is that of a calibration file.
    is_calibrated: ClassVar[bool] = False

    @classmethod
    def recognise(cls, path: Path) -> str | None:
        """See :class:`DataManager`."""
        return files.recognise(path) if files.is_calibrated(path) == cls.is_calibrated else None

    def open(self, path: Path) -> Recording:
        """See :class:`RecordedDataManager`."""
        settings = self.settings
        images = files.find_images(path)
        depths = files.find_depths(path) if settings.depth == "metric" else []
        file = files.find_trajectory(path, settings.trajectory)
        trajectory = tum.read(file)
        by_time = self._by_time(images)
        pair = self._paired_by_time if by_time else self._paired_by_order
        frames = pair(images, depths, trajectory, file)
        camera = files.find_camera(path, frames.images[0])
        scale = self._depth_scale(camera, path) if depths else None
        form = None if scale is None else DepthSteps(1.0 / scale)
        (rectification,) = rectifications(
            {0: camera.lens}, camera.path, self.working_size, settings.focal_scale
        ).values()
        complete = len(frames.images) == len(images) == len(trajectory)
        seen = find_seen_masks(path / "truth", len(images), complete)
        masks = files.files_of_images(path, files.MASK_FOLDERS, frames.images, "mask")
        confidences: dict[str, Path] = {}
        if settings.depth == "metric":
            confidences = files.files_of_images(path, files.CONFIDENCE_FOLDERS, frames.images, "confidence")
        if confidences and not depths:
            raise InputError(
                f"{path} holds confidence/, but no depth",
                "confidence beside the depth that it is about",
                "Add the depth, or move confidence/ away",
            )
        shots = [
            Shot(
                image.stem,
                image,
                rectification,
                trajectory.camera_to_world[pose],
                depth,
                form,
                mask=masks.get(image.stem),
                seen=seen.get(index),
                confidence=confidences.get(image.stem),
            )
            for index, (image, depth, pose) in enumerate(zip(frames.images, frames.depths, frames.poses, strict=True))
        ]
        facts: dict[str, Any] = {
            "layout": "TUM RGB-D",
            "trajectory": file.name,
            "intrinsics_from": camera.path.name,
            "lens": type(camera.lens).__name__,
            "focal_scale": None if isinstance(camera.lens, PinholeLens) else settings.focal_scale,
            "depth_scale": scale,
            "association": frames.facts,
            "masks": len(masks),
            "depth_is_estimated": bool(confidences),
            **rectification.facts(),
            "pose_convention": {
                "order": "TUM: camera-to-world, quaternion with w last",
                "poses": len(trajectory),
                "summary": trajectory.summary(printed_unit(self.stated_unit(path))),
            },
        }
        points = next((file for file in (path / POINTS_FILE, files.find_mesh(path)) if file and file.is_file()), None)
        return Recording(
            kind=f"TUM RGB-D, associated by {frames.facts['by']}",
            shots=shots,
            facts=facts,
            fingerprint=fingerprint(
                path, (*frames.images, *frames.depths, *masks.values(), *confidences.values()), (file, camera.path)
            ),
            own_points=None
            if points is None
            else partial(files.read_mesh_points if points.suffix == ".obj" else load_points, points),
            points_source=points,
        )

    def _by_time(self, images: Sequence[Path]) -> bool:
        if self.settings.association != "auto":
            return self.settings.association == "time"
        timed = [files.is_time(path.stem) for path in images]
        if any(timed) and not all(timed):
            raise InputError(
                f"{images[timed.index(False)]} is not named by a timestamp, but {images[timed.index(True)].name} is",
                "only timestamps, or only frame numbers",
                "Rename, or choose with the option association",
            )
        return all(timed)

    def _paired_by_time(
        self, images: Sequence[Path], depths: Sequence[Path], trajectory: Trajectory, file: Path
    ) -> _Frames:
        tolerance = self.settings.max_time_difference
        taken = files.times(images)
        order = np.argsort(taken, kind="stable")
        images, taken = [images[index] for index in order], taken[order]
        same = np.flatnonzero(np.diff(taken) == 0.0)
        if len(same):
            first = int(same[0])
            raise InputError(f"{images[first]} and {images[first + 1].name} have the same timestamp", "one of them")
        known = np.zeros(0) if trajectory.timestamps is None else trajectory.timestamps
        # Names are rounded to microseconds; pairs exactly at the tolerance must match.
        within = tolerance + 1e-6
        pose = nearest_in_time(taken, known, within)
        if not (pose >= 0).any():
            raise InputError(
                f"no pose of {file} is within {tolerance:g} of an image: images from {taken[0]:.6f} to "
                f"{taken[-1]:.6f}, poses from {known.min():.6f} to {known.max():.6f}",
                "timestamps of one clock in names and trajectory, in seconds",
                "Shift the trajectory's timestamps, or --set datamanager.association=order if line n is image n's",
            )
        posed = pose >= 0
        depth = np.full(len(images), -1)
        complete = posed.copy()
        if depths:
            depth[posed] = nearest_in_time(taken[posed], files.times(depths), within)
            complete &= depth >= 0
        if not complete.any():
            raise InputError(
                f"no depth file within {tolerance:g} of an image that has a pose",
                "depth files named by timestamps of the images' clock",
                "Rename them, or --set datamanager.depth=none",
            )
        kept = np.flatnonzero(complete)
        dropped = {"without_pose": int((~posed).sum()), "without_depth": int((posed & ~complete).sum())}
        if sum(dropped.values()):
            log.warning(
                "%s: of %d images %d have no pose and %d no depth within %g s; they are left out",
                file.parent,
                len(images),
                *dropped.values(),
                tolerance,
            )
        difference = np.abs(taken[kept] - known[pose[kept]]).max()
        facts = {"by": "time", **dropped, "largest_difference_s": float(difference)}
        return _Frames(
            [images[index] for index in kept],
            [depths[depth[index]] if depths else None for index in kept],
            [int(pose[index]) for index in kept],
            facts,
        )

    def _paired_by_order(
        self, images: Sequence[Path], depths: Sequence[Path], trajectory: Trajectory, file: Path
    ) -> _Frames:
        numbered = files.by_number(images)
        if len(trajectory) != len(numbered):
            raise InputError(
                f"{file} has {len(trajectory)} poses for {len(numbered)} images",
                "a pose for every image, in order",
                "Restore the missing ones, or --set datamanager.association=time if its timestamps name images",
            )
        self._check_times_say_the_same(numbered, trajectory, file)
        deep = files.by_number(depths)
        if deep and deep.keys() != numbered.keys():
            lone = min(deep.keys() ^ numbered.keys())
            raise InputError(
                f"{file.parent} has {len(numbered)} images and {len(deep)} depth files; frame "
                f"{' '.join(map(str, lone))} has only one of the two",
                "a depth file for every image, or none at all",
                "Restore the missing files, or --set datamanager.depth=none",
            )
        return _Frames(
            list(numbered.values()), [deep.get(key) for key in numbered], range(len(numbered)), {"by": "order"}
        )

    def _check_times_say_the_same(
        self, numbered: dict[tuple[int, ...], Path], trajectory: Trajectory, file: Path
    ) -> None:
        """Refuse a trajectory whose timestamps are frame numbers that match most, but not all, images."""
        if trajectory.timestamps is None or self.settings.association == "order":
            return
        named = np.array([key[0] if len(key) == 1 else -1 for key in numbered], np.float64)
        agrees = named == trajectory.timestamps
        if 0.5 < agrees.mean() < 1.0 or (set(named) == set(trajectory.timestamps) and not agrees.all()):
            index = int(np.argmin(agrees))
            raise InputError(
                f"{file}: pose {index} has timestamp {trajectory.timestamps[index]:g}, but image {index} is "
                f"{list(numbered.values())[index].name}",
                "line n for image n, or timestamps equal to the image names",
                "--set datamanager.association=time if the names are timestamps, or order if these mean nothing",
            )

    def _depth_scale(self, camera: files.CameraFile, path: Path) -> float:
        said, given = camera.depth_scale, self.settings.depth_scale
        if said is not None and given is not None and said != given:
            raise InputError(
                f"{camera.path}: depth_scale = {said:g}, but the option depth_scale is {given:g}",
                "one depth_scale",
                "Leave the option out, or correct the file",
            )
        scale = said if said is not None else given
        if scale is None:
            raise InputError(
                f"{path} has depth files, but their number of steps per unit of the trajectory is not given",
                '"depth_scale" in camera.json, <depth_scale> in a calibration file, or the option depth_scale; TUM\'s '
                "files have 5000 steps per metre",
                "For instance --set datamanager.depth_scale=5000; or --set datamanager.depth=none if it is relative",
            )
        return scale


class EndoMapperDataManager(RGBDDataManager):
    """Reads posed sequences of EndoMapper (Azagra et al., 2023): fisheye images, depth and a calibration.

    See docs/layouts/endomapper.md.
    """

    name = "endomapper"
    is_calibrated = True
