"""Data manager for TUM's RGB-D layout, as read and written by SLAM systems and Gaussian Pancakes."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from typing_extensions import override

from coliags_plugin.core import scene_files as reading
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import read_json, read_number
from coliags_plugin.core.scene_files import printed_unit
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.core.text_files import read_text, shortened
from coliags_plugin.datamanagers.file_formats import ScaledDepth, size_of
from coliags_plugin.datamanagers.fusion import load_points
from coliags_plugin.datamanagers.recorded import POINTS_FILE, RecordedDataManager, Recording, SceneSettings
from coliags_plugin.datamanagers.shots import make_shots
from coliags_plugin.geometry.lenses.models import Lens, PinholeLens
from coliags_plugin.geometry.lenses.vicalib import calibration_files, find_calibration
from coliags_plugin.geometry.meshes.mesh import read_mesh
from coliags_plugin.geometry.poses import tum
from coliags_plugin.geometry.poses.alignment import nearest_in_time
from coliags_plugin.geometry.poses.colmap import read_pinholes
from coliags_plugin.geometry.poses.formats import count_first_numbers
from coliags_plugin.geometry.poses.trajectory import Trajectory, natural_order

log = logging.getLogger(__name__)

IMAGE_FOLDERS = ("rgb", "color", "images")
DEPTH_FOLDERS = ("depth", "depths")
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


#: A camera file, its lens of the stored images, and depth steps per scene unit if it gives them.
_Camera = tuple[Path, Lens, float | None]
#: Images, their depth files if there are any, the indices of their poses, and provenance.
_Association = tuple[list[Path], list[Path | None], np.ndarray, dict[str, Any]]


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


class RGBDDataManager(RecordedDataManager):
    """Reads images, depth and a TUM trajectory (docs/layouts/rgbd.md)."""

    Settings = RGBDSettings

    settings: RGBDSettings
    name = "rgbd"
    masks_at = "mask/NAME.png or masks/NAME.png"
    unit = "unknown"
    #: Whether this format's camera is that of a calibration file.
    is_calibrated: ClassVar[bool] = False

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        calibrated = not any((path / name).is_file() for name in CAMERA_FILES) and bool(calibration_files(path))
        images = next((name for name in IMAGE_FOLDERS if (path / name).is_dir()), None)
        trajectory = next((file for file in _trajectories(path) if count_first_numbers(file) == 8), None)
        if images is None or trajectory is None or calibrated != cls.is_calibrated:
            return None
        return f"the TUM trajectory {trajectory.name} beside {images}/"

    @classmethod
    def refuse_nearly(cls, path: Path) -> None:
        """Raise InputError for a folder of images beside a text file that is nearly a TUM trajectory."""
        if any((path / name).is_dir() for name in IMAGE_FOLDERS):
            for file in _trajectories(path)[:1]:
                tum.read(file)

    @override
    def open(self, path: Path) -> Recording:
        settings = self.settings
        images = _find_images(path)
        is_metric = settings.depth == "metric"
        depths = _find_depths(path) if is_metric else []
        file = _find_trajectory(path, settings.trajectory)
        trajectory = tum.read(file)
        pair = self._paired_by_time if self._is_by_time(images) else self._paired_by_order
        used, depth_files, poses, association = pair(images, depths, trajectory, file)
        camera_file, lens, stated_scale = _find_camera(path, used[0])
        scale = self._depth_scale(stated_scale, camera_file) if depths else None
        rectification = self.rectification_of(lens, camera_file)
        masks = _files_of_images(path, reading.MASK_FOLDERS, used, "mask")
        confidences = _files_of_images(path, CONFIDENCE_FOLDERS if is_metric else (), used, "confidence")
        form = None if scale is None else ScaledDepth(1.0 / scale)
        camera_to_world = trajectory.camera_to_world[poses]
        shots = make_shots(used, rectification, camera_to_world, depth_files, form, "", masks, confidences)
        facts: dict[str, Any] = {
            "layout": "TUM RGB-D",
            "trajectory": file.name,
            "intrinsics_from": camera_file.name,
            "lens": type(lens).__name__,
            "depth_scale": scale,
            "association": association,
            "pose_convention": {
                "order": f"TUM: {trajectory.stored_as}",
                "poses": len(trajectory),
                "summary": trajectory.summary(printed_unit(self.stated_unit(path))),
            },
        }
        meshes = list(path.glob("[!.]*.obj"))
        points = next((file for file in (path / POINTS_FILE, *meshes[: len(meshes) == 1]) if file.is_file()), None)
        return Recording(
            folder=path,
            kind=f"TUM RGB-D, associated by {association['by']}",
            shots=shots,
            facts=facts,
            described_by=(file, camera_file),
            points_source=points,
            read_points=_read_mesh_points if points is not None and points.suffix == ".obj" else load_points,
            is_complete=len(used) == len(images) == len(trajectory),
        )

    def _is_by_time(self, images: Sequence[Path]) -> bool:
        if self.settings.association != "auto":
            return self.settings.association == "time"
        timed = [_TIME.fullmatch(path.stem) is not None for path in images]
        if any(timed) and not all(timed):
            raise InputError(
                f"{images[timed.index(False)]} is not named by a timestamp, but {images[timed.index(True)].name} is",
                "only timestamps, or only frame numbers",
                "Rename, or choose with the option association",
            )
        return all(timed)

    def _paired_by_time(
        self, images: Sequence[Path], depths: Sequence[Path], trajectory: Trajectory, file: Path
    ) -> _Association:
        """Images with a pose, and depth if there is any, in order of time; and provenance."""
        tolerance = self.settings.max_time_difference
        # Names are rounded to microseconds; pairs exactly at the tolerance must match.
        within = tolerance + 1e-6
        images = sorted(images, key=_time)
        times = np.array([_time(image) for image in images])
        for first in np.flatnonzero(np.diff(times) == 0.0):
            raise InputError(f"{images[first]} and {images[first + 1].name} have the same timestamp", "one of them")
        stamps = np.zeros(0) if trajectory.timestamps is None else trajectory.timestamps
        pose = nearest_in_time(times, stamps, within)
        posed = np.flatnonzero(pose >= 0)
        if not len(posed):
            raise InputError(
                f"no pose of {file} is within {tolerance:g} of an image: images from {times[0]:.6f} to "
                f"{times[-1]:.6f}, poses from {stamps.min():.6f} to {stamps.max():.6f}",
                "timestamps of one clock in names and trajectory, in seconds, not nanoseconds",
                "Shift the trajectory's timestamps, or `datamanager.association=order` if line n is image n's",
            )
        deep = np.zeros(len(posed), np.int64)
        if depths:
            deep = nearest_in_time(times[posed], np.array([_time(depth) for depth in depths]), within)
        used = posed[deep >= 0]
        if not len(used):
            raise InputError(
                f"no depth file within {tolerance:g} of an image that has a pose",
                "depth files named by timestamps of the images' clock",
                "Rename them, or `datamanager.depth=none`",
            )
        without = {"without_pose": len(images) - len(posed), "without_depth": len(posed) - len(used)}
        if any(without.values()):
            said = "%s: of %d images %d have no pose and %d no depth within %g s; they are left out"
            log.warning(said, file.parent, len(images), *without.values(), tolerance)
        difference = float(np.abs(times[used] - stamps[pose[used]]).max())
        facts = {"by": "time", **without, "largest_difference_s": difference}
        deep_files = [depths[index] if depths else None for index in deep[deep >= 0]]
        return [images[index] for index in used], deep_files, pose[used], facts

    def _paired_by_order(
        self, images: Sequence[Path], depths: Sequence[Path], trajectory: Trajectory, file: Path
    ) -> _Association:
        """Images in order of their numbers, each with its depth if there is any, and the pose of its place."""
        numbered, deep = _by_number(images), _by_number(depths)
        if len(trajectory) != len(numbered):
            raise InputError(
                f"{file} has {len(trajectory)} poses for {len(numbered)} images",
                "a pose for every image, in order",
                "Restore the missing ones, or `datamanager.association=time` if its timestamps name images",
            )
        self._check_times_say_the_same(numbered, trajectory, file)
        do = "Restore the missing files, or `datamanager.depth=none`"
        names, deep_names = ([" ".join(map(str, key)) for key in files] for files in (numbered, deep))
        reading.same_frames(file.parent, names, deep_names, do)
        return [*numbered.values()], [deep.get(key) for key in numbered], np.arange(len(numbered)), {"by": "order"}

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
                "`datamanager.association=time` if the names are timestamps, or order if these mean nothing",
            )

    def _depth_scale(self, stated: float | None, file: Path) -> float:
        """Depth steps per scene unit, as the camera's file and the option say."""
        option = self.settings.depth_scale
        if stated is not None and option is not None and stated != option:
            raise InputError(
                f"{file}: depth_scale = {stated:g}, but the option depth_scale is {option:g}",
                "one depth_scale",
                "Leave the option out, or correct the file",
            )
        scale = stated if stated is not None else option
        if scale is None:
            raise InputError(
                f"{file.parent} has depth files, but their number of steps per unit of the trajectory is not given",
                '"depth_scale" in camera.json, <depth_scale> in a calibration file, or the option depth_scale; TUM\'s '
                "files have 5000 steps per metre",
                "For instance `datamanager.depth_scale=5000`; or `datamanager.depth=none` if it is relative",
            )
        return scale


class EndoMapperDataManager(RGBDDataManager):
    """Reads posed sequences of EndoMapper (Azagra et al., 2023): fisheye images, depth and a calibration.

    See docs/layouts/endomapper.md.
    """

    name = "endomapper"
    is_calibrated = True


def _find_images(folder: Path) -> list[Path]:
    """The colour images; there must be one folder of them."""
    reading.require_folder(folder, EXPECTED)
    image_folder = reading.one_folder(folder, IMAGE_FOLDERS)
    if image_folder is None:
        raise InputError(f"{folder} holds {reading.inventory(folder)}", EXPECTED, "Name the scene's own folder")
    images = reading.files_in(image_folder, reading.IMAGE_SUFFIXES)
    if not images:
        raise InputError(f"{image_folder} holds {reading.inventory(image_folder)}", "PNG or JPEG images")
    return images


def _find_depths(folder: Path) -> list[Path]:
    """The depth files, unordered: images, or arrays where there are none."""
    depth_folder = reading.one_folder(folder, DEPTH_FOLDERS)
    if depth_folder is None:
        return []
    kinds = (reading.DEPTH_SUFFIXES, reading.ARRAY_SUFFIXES)
    depths = next(filter(None, (reading.files_in(depth_folder, suffixes) for suffixes in kinds)), [])
    if not depths:
        reading.warn_of_other_kinds(sorted(depth_folder.iterdir()), frozenset().union(*kinds))
    return depths


def _files_of_images(folder: Path, names: Sequence[str], images: Sequence[Path], what: str) -> Sequence[Path | None]:
    """Files of the stems of images, such as masks, where there is a folder of one of the ``names``, else None for each.

    The folder must have one for every image; ``what`` they are is for the error.
    """
    file_folder = reading.one_folder(folder, names)
    if file_folder is None:
        return [None] * len(images)
    files = reading.sidecar_files(file_folder, [image.name for image in images], reading.MASK_SUFFIXES)
    return reading.for_every(files, file_folder, f"a {what}")


def _find_trajectory(folder: Path, named: str | None) -> Path:
    """The trajectory file: the one the user names, relative to the folder or absolute, or the only one there is."""
    if named is not None:
        return reading.required_file(folder / named, "a TUM trajectory", "Correct the option trajectory")
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
            f"Choose with the option trajectory, for instance `datamanager.trajectory={trajectories[0].name}`",
        )
    return trajectories[0]


def _find_camera(folder: Path, image: Path) -> _Camera:
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
    return calibration.path, calibration.lens, calibration.depth_scale


def _read_mesh_points(path: Path) -> PointCloud:
    """The vertices of a mesh, and their colours if all have one."""
    mesh = read_mesh(path)
    return PointCloud(torch.from_numpy(mesh.vertices), None if mesh.colors is None else torch.from_numpy(mesh.colors))


def _trajectories(folder: Path) -> list[Path]:
    return sorted(
        {path for pattern in TRAJECTORIES for path in folder.glob(pattern) if path.is_file() and path.name[0] != "."}
    )


def _read_json(path: Path, image: Path) -> _Camera:
    lens, content = PinholeLens.of(reading.read_intrinsics(path)), read_json(path, "a JSON object")
    expected = "a number above 0: depth steps per scene unit"
    has_scale = content.get("depth_scale") is not None
    return path, lens, read_number(content, "depth_scale", path, expected, above=0.0) if has_scale else None


def _read_intrinsics_txt(path: Path, image: Path) -> _Camera:
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
    return path, PinholeLens(fx, fy, cx + 0.5, cy + 0.5, width, height), None


def _read_cameras_txt(path: Path, image: Path) -> _Camera:
    cameras = list(read_pinholes(path).values())
    if len(cameras) != 1:
        raise InputError(f"{path} has {len(cameras)} cameras", "one, PINHOLE or SIMPLE_PINHOLE")
    camera = cameras[0]
    if isinstance(camera, str):
        raise InputError(f"{path}: {camera}", "PINHOLE or SIMPLE_PINHOLE", "Undistort the images first")
    return path, PinholeLens.of(camera), None


def _by_number(paths: Sequence[Path]) -> dict[tuple[int, ...], Path]:
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
