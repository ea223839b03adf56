"""Data manager for C3VD as prepared by EndoGSLAM, with EndoGSLAM's poses and map; also PR-Endo's release."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from scipy.spatial.transform import Rotation
from typing_extensions import override

from coliags_plugin.core import scene_files as reading
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import user_path
from coliags_plugin.core.images import decode_image
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.ply import read_vertices
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.core.splits import Split
from coliags_plugin.datamanagers.file_formats import C3VD_DEPTH, ScaledDepth
from coliags_plugin.datamanagers.recorded import (
    ROTATION,
    InitialPoints,
    RecordedDataManager,
    Recording,
    SceneSettings,
    poses_of_images,
)
from coliags_plugin.datamanagers.shots import Rectification, Shot, make_shots, whole_frame
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.poses.c3vd import C3vdPoses
from coliags_plugin.geometry.poses.endogslam import EndoGslamParams, image_indices, read_params
from coliags_plugin.geometry.poses.formats import count_first_numbers
from coliags_plugin.geometry.poses.trajectory import inverse, rigid, rotation_angles_deg

log = logging.getLogger(__name__)

PARAMS = "params.npz"
PoseSource = Literal["slam", "ground-truth"]

#: Largest difference of params.npz's true poses from pose.txt, mm and degrees. Rounding is a thousandth of this;
#: another sequence, or another order of frames, differs by millimetres.
SAME_SEQUENCE = 0.05
#: Ratio of the ATE to the spread of the cameras from which tracking counts as lost.
LOST = 0.2


class PreparedFiles(NamedTuple):
    """The files of one sequence, frame 0 first."""

    folder: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: Path | None
    params: Path | None  # EndoGSLAM's result
    cloud: Path | None  # the optimised Gaussians of PR-Endo's release


class SequencePoses(NamedTuple):
    """The poses of a sequence in one world. Rigid, OpenCV axes, mm."""

    camera_to_world: Float[np.ndarray, "N 4 4"]
    from_slam: Float[np.ndarray, "4 4"] | None  # from EndoGSLAM's world; None without its result
    from_file: Float[np.ndarray, "4 4"] | None  # from the world of pose.txt; None without the file
    facts: Mapping[str, Any]


def load_poses(files: PreparedFiles, params: EndoGslamParams | None, source: PoseSource) -> SequencePoses:
    """Load the poses of a sequence's images; ``params`` are the contents of ``files.params``.

    ``slam``: EndoGSLAM's poses, in its world; images it did not track get their true poses, transformed to it.
    ``ground-truth``: the true poses, in the world of pose.txt, or without it of the first camera.
    """
    count = len(files.images)
    file = None if files.poses is None else poses_of_images(files.poses, count)
    facts: dict[str, Any] = {
        "poses": source,
        "pose_convention": None if file is None else {"order": file.convention, **file.evidence},
        "slam": None,
    }
    if params is None and source == "slam":
        raise InputError(
            f"{files.folder} has no {PARAMS}, in it or where PR-Endo's release has it",
            "EndoGSLAM's result, for option poses: slam",
            "Name it with `datamanager.params_file=FILE`, or `datamanager.poses=ground-truth`",
        )
    indices = np.zeros(0, np.int64)
    if params is not None:
        indices, from_true, facts["slam"] = _align_slam(files, params, file)
    if file is None and len(indices) != count:
        raise InputError(
            f"{files.folder} has no pose.txt, and its {PARAMS} poses of {len(indices)} of {count} images",
            "a pose for every image",
            "Put the sequence's pose.txt of C3VD's release there",
        )
    if params is None:
        assert file is not None  # as there are poses
        return SequencePoses(file.camera_to_world, None, np.eye(4), {**facts, "world": "pose.txt"})
    # The true poses of params.npz are relative to the first camera.
    first = np.eye(4) if file is None else file.camera_to_world[0]
    from_file = None if file is None else from_true @ _inverse(first)
    if source == "ground-truth":
        true, world = (
            (params.true_camera_to_world, "first camera") if file is None else (file.camera_to_world, "pose.txt")
        )
        to_itself = None if file is None else np.eye(4)
        return SequencePoses(true, first @ _inverse(from_true), to_itself, {**facts, "world": world})
    camera_to_world = params.camera_to_world
    if file is not None and len(indices) != count:
        camera_to_world = from_file @ file.camera_to_world
        camera_to_world[indices] = params.camera_to_world
    return SequencePoses(camera_to_world, np.eye(4), from_file, {**facts, "world": "first camera, as mapped"})


def _align_slam(
    files: PreparedFiles, params: EndoGslamParams, file: C3vdPoses | None
) -> tuple[Int[np.ndarray, "F"], Float[np.ndarray, "4 4"], dict[str, Any]]:
    """Align EndoGSLAM's trajectory with the true one.

    Returns image indices of its poses, the transform to its world from that of the true poses, relative to their first
    camera, and provenance.
    """
    path, count, poses = files.params, len(files.images), len(params.camera_to_world)
    indices = image_indices(poses, count)
    if indices is None:
        raise InputError(
            f"{path} has {poses} poses for {count} images in {files.folder}",
            f"{count} (one for every image) or {count - count // 8} (all but 7, 15, 23, ...)",
            "Give the params.npz of this sequence, run on all of its images",
        )
    compared = None
    if file is not None:
        true = _inverse(file.camera_to_world[0]) @ file.camera_to_world[indices]
        compared = _compared(files, params.true_camera_to_world, true, indices)
    from_true = _rigid_alignment(params.true_camera_to_world, params.camera_to_world)
    aligned = from_true @ params.true_camera_to_world
    errors = np.linalg.norm(aligned[:, :3, 3] - params.camera_to_world[:, :3, 3], axis=1)
    ate, spread = float(np.sqrt(np.mean(errors**2))), float(aligned[:, :3, 3].std(axis=0).max())
    if ate > LOST * spread:
        log.warning(
            "%s: EndoGSLAM's cameras are %.3g mm (RMS) from the true ones, which spread over %.3g mm: tracking failed "
            "or stopped early",
            path,
            ate,
            spread,
        )
    facts = {
        "params": str(path),
        "frames": poses,
        "images": "every" if poses == count else "all but 7, 15, 23, ...",
        "compared_with_pose_file": compared,
        "ate_rmse_mm": ate,
    }
    return indices, from_true, facts


def _compared(
    files: PreparedFiles,
    stored: Float[np.ndarray, "F 4 4"],
    true: Float[np.ndarray, "F 4 4"],
    indices: Int[np.ndarray, "F"],
) -> dict[str, float]:
    """Largest differences between the true poses of params.npz and pose.txt."""
    distances = np.linalg.norm(stored[:, :3, 3] - true[:, :3, 3], axis=1)
    angles = rotation_angles_deg(stored[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1))
    worst = int(np.argmax(np.maximum(distances, angles)))
    if max(distances[worst], angles[worst]) > SAME_SEQUENCE:
        raise InputError(
            f"{files.params}: the true pose of image {indices[worst]} is {distances[worst]:.3g} mm and "
            f"{angles[worst]:.3g} degrees from that of {files.poses}",
            f"both within {SAME_SEQUENCE:g}, both relative to the first camera",
            "It belongs to another sequence or to other images: give this sequence's params.npz",
        )
    return {"largest_distance_mm": float(distances.max()), "largest_angle_deg": float(angles.max())}


def _rigid_alignment(
    source: Float[np.ndarray, "F 4 4"], target: Float[np.ndarray, "F 4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Rigid alignment of two trajectories of the same frames: mean relative rotation, then mean translation.

    The rotation is estimated from orientations, since a colonoscope's path is nearly a straight line, and positions
    leave the rotation about it undetermined.
    """
    rotations = target[:, :3, :3] @ source[:, :3, :3].transpose(0, 2, 1)
    rotation = Rotation.from_matrix(rotations).mean().as_matrix()
    translation = (target[:, :3, 3] - source[:, :3, 3] @ rotation.T).mean(axis=0)
    return rigid(rotation[None], translation[None])[0]


def _inverse(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    return inverse(matrix[None])[0]


LAYOUT = (
    "EndoGSLAM's C3VD: color/NNNN_color.png and depth/NNNN_depth.tiff with pose.txt, params.npz or both; "
    "or PR-Endo's: C3VD/<scene> beside C3VD_endogslam_optimized/<scene>"
)
#: PR-Endo's release has the scenes in a folder X and EndoGSLAM's results in X_endogslam_optimized.
OPTIMIZED = "_endogslam_optimized"
#: K of the prepared images, half of the calibration behind them (docs/layouts/c3vd.md 2), as EndoGSLAM has it, with
#: pixel centres at integers: hence + 0.5.
PREPARED_PINHOLE = Intrinsics(401.1595, 400.9425, 334.1430 + 0.5, 273.8665 + 0.5, 675, 540)
#: EndoGSLAM's 8-bit depth: 2.55 steps per mm, rounded down; 255 is the end of C3VD's range.
PREPARED_DEPTH = ScaledDepth(100.0 / 255.0, 8, 255)
#: How far a principal point may be from the middle, as a share of the image; prepared images have 0.7 %.
MIDDLE_TOLERANCE = 0.1
#: Value of the first spherical harmonic: the colour of a 3DGS PLY is this times f_dc, plus a half.
SH0 = 0.28209479177387814


class C3VDEndoGSLAMSettings(SceneSettings):
    """Options of the ``c3vd-endogslam`` data manager."""

    poses: PoseSource = Field("slam", description="'slam': EndoGSLAM's estimated poses; 'ground-truth': the dataset's.")
    params_file: str | None = Field(
        None,
        description="EndoGSLAM's params.npz, relative to the scene folder or absolute. None: params.npz in the scene "
        "folder, or where PR-Endo's release has it.",
    )
    split: Split = Field(
        "endogslam", description="As for all data managers; EndoGSLAM and PR-Endo test on 7, 15, 23, ..."
    )
    initial_points: InitialPoints = Field("data", description="As for all data managers; 'data' is EndoGSLAM's map.")


class C3VDEndoGSLAMDataManager(RecordedDataManager):
    """Reads C3VD with EndoGSLAM's poses and map: EndoGSLAM's own folders, or PR-Endo's release.

    See docs/layouts/c3vd-endogslam.md. A sub-folder ``rotation``, with its own pose.txt, becomes the test set of that
    name; ``rotation/seen`` and ``truth/seen`` hold the seen masks for :attr:`seen_split`.
    """

    Settings = C3VDEndoGSLAMSettings

    settings: C3VDEndoGSLAMSettings
    name = "c3vd-endogslam"
    #: EndoGSLAM and PR-Endo publish at the stored size.
    fits = None
    seen_split = "endogslam"

    @classmethod
    @override
    def recognise(cls, path: Path) -> str | None:
        images = any(re.fullmatch(r"\d+_color", image.stem) for image in path.glob("color/*.png"))
        poses = path / "pose.txt"
        if images and _params(path, None) is not None:
            return "color/NNNN_color.png and a params.npz"
        if images and poses.is_file() and count_first_numbers(poses) == 16:
            return "pose.txt (16 numbers a line) beside color/NNNN_color.png"
        if not images and (beside := _release(path)):
            return f"{beside[0].parent.name}{OPTIMIZED}/ beside {beside[0].parent.name}/"
        return None

    @override
    def open(self, path: Path) -> Recording:
        folder = _scene_folder(path)
        files = _find_sequence(folder, self.settings.params_file)
        params = None if files.params is None else read_params(files.params)
        poses = load_poses(files, params, self.settings.poses)
        rectification = self._rectification(files, params)
        depth_format = _depth_format(files)
        facts: dict[str, Any] = {
            "layout": "endogslam" if files.cloud is None else "pr-endo",
            "scene": folder.name,
            **poses.facts,
            "intrinsics_from": "EndoGSLAM's table" if files.params is None else str(files.params),
            "depth_step_mm": None if depth_format is None else depth_format.size,
        }
        shots = make_shots(files.images, rectification, poses.camera_to_world, files.depths, depth_format)
        test_sets = {}
        if (folder / ROTATION).is_dir():
            test_sets[ROTATION] = self._rotation(folder / ROTATION, rectification, poses)
        return Recording(
            folder=folder,
            kind=f"{facts['layout']} layout, {self.settings.poses} poses",
            shots=shots,
            facts=facts,
            described_by=(files.poses, files.params),
            test_sets=test_sets,
            points_source=files.cloud or files.params or folder / PARAMS,
            read_points=partial(_map_points, params, poses)
            if params is not None and (files.cloud or len(params.means))
            else None,
        )

    def _rectification(self, files: PreparedFiles, params: EndoGslamParams | None) -> Rectification:
        calibrated, described_by = PREPARED_PINHOLE, "EndoGSLAM's calibration"
        if params is not None and files.params is not None:
            calibrated, described_by = params.intrinsics, str(files.params)
        do = "Give the params.npz that was made from these images"
        lens = whole_frame(PinholeLens.of(calibrated), files.images[0], described_by, do)
        pinhole = lens.pinhole
        off_middle = max(abs(pinhole.cx / lens.width - 0.5), abs(pinhole.cy / lens.height - 0.5))
        if off_middle > MIDDLE_TOLERANCE:
            raise InputError(
                f"{described_by}: the principal point ({pinhole.cx:g}, {pinhole.cy:g}) is {100 * off_middle:.0f} % of "
                f"the image ({lens.width} x {lens.height}) from its middle",
                "intrinsics of the size that org_width and org_height say",
                "They are of another resolution: correct org_width and org_height, or the intrinsics",
            )
        return self.rectification_of(lens, files.images[0])

    def _rotation(self, folder: Path, rectification: Rectification, poses: SequencePoses) -> list[Shot]:
        files = _find_sequence(folder, None)
        if files.poses is None or poses.from_file is None:
            raise InputError(
                f"{folder} has images, but {'the scene' if files.poses else 'it'} has no pose.txt",
                "pose.txt of the scene and of its rotation views, in one world",
                f"Add it, or move {folder.name} away",
            )
        rotation = poses_of_images(files.poses, len(files.images)).camera_to_world
        camera_to_world, form = poses.from_file @ rotation, _depth_format(files)
        return make_shots(files.images, rectification, camera_to_world, files.depths, form, f"{ROTATION}-")


def _depth_format(files: PreparedFiles) -> ScaledDepth | None:
    """EndoGSLAM's 8-bit or C3VD's 16-bit format, by the first file; all files must have the same."""
    if files.depths is None:
        return None
    return PREPARED_DEPTH if decode_image(files.depths[0]).dtype == np.uint8 else C3VD_DEPTH


def _map_points(params: EndoGslamParams, poses: SequencePoses, source: Path) -> PointCloud:
    """Points of EndoGSLAM's map, a PLY file or params.npz, in the world of the poses."""
    positions, shares = params.means, params.rgb_colors
    if source.suffix == ".ply":
        names = tuple(f"f_dc_{channel}" for channel in range(3))
        vertices = read_vertices(source, ("x", "y", "z", *names))
        positions = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
        shares = SH0 * np.stack([vertices[name] for name in names], axis=1) + 0.5
    colors = np.rint(255.0 * np.clip(np.nan_to_num(shares), 0.0, 1.0)).astype(np.uint8)
    if poses.from_slam is not None:
        positions = positions @ poses.from_slam[:3, :3].T + poses.from_slam[:3, 3]
    return PointCloud(torch.from_numpy(positions.astype(np.float32)), torch.from_numpy(colors))


def _scene_folder(path: Path) -> Path:
    """The sequence's folder: ``path`` itself, or the only scene of PR-Endo's release in it."""
    reading.require_folder(path, LAYOUT)
    scenes = [] if (path / "color").is_dir() else _release(path)
    if len(scenes) > 1:
        raise InputError(f"{path} holds several scenes", "one scene", f"Name one, for instance {sorted(scenes)[0]}")
    return scenes[0] if scenes else path


def _find_sequence(folder: Path, params_file: str | None) -> PreparedFiles:
    """Find the files of the sequence in the folder that contains ``color``.

    ``params_file`` is EndoGSLAM's result, relative to the folder or absolute; None: search in the folder and in
    PR-Endo's release.
    """
    images = reading.numbered_images(folder / "color", "color", LAYOUT, "C3VD/cecum_t1_b")
    depths = reading.numbered(folder / "depth", "depth", reading.TIFF_SUFFIXES)
    params = _params(folder, params_file)
    poses = folder / "pose.txt"
    return PreparedFiles(
        folder,
        *reading.paired(folder, images, depths),
        poses if poses.is_file() else None,
        params,
        None if params is None else _newest_cloud(params.parent),
    )


def _params(folder: Path, params_file: str | None) -> Path | None:
    if params_file is not None:
        return reading.required_file(folder / user_path(params_file), "EndoGSLAM's params.npz", "Correct params_file")
    here = folder.resolve()
    beside = here.parent.with_name(here.parent.name + OPTIMIZED) / here.name if here.parent.name else here
    return next((path / PARAMS for path in (folder, beside) if (path / PARAMS).is_file()), None)


def _newest_cloud(folder: Path) -> Path | None:
    """``point_cloud/iteration_N/point_cloud.ply`` of the largest N."""
    clouds = {
        int(match.group(1)): path
        for path in folder.glob("point_cloud/iteration_*/point_cloud.ply")
        if (match := re.fullmatch(r"iteration_(\d+)", path.parent.name))
    }
    return clouds[max(clouds)] if clouds else None


def _release(folder: Path) -> list[Path]:
    """The scenes of PR-Endo's release in a folder for which EndoGSLAM's result exists."""
    return [
        scene
        for results in folder.glob(f"*{OPTIMIZED}")
        for scene in (folder / results.name.removesuffix(OPTIMIZED)).glob("*")
        if (scene / "color").is_dir() and (results / scene.name / PARAMS).is_file()
    ]
