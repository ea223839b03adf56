"""Combines EndoGSLAM's and ground-truth poses of a sequence in one world (docs/layouts/c3vd-endogslam.md 4)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.recording import check_pose_count
from coliags_plugin.geometry.poses.c3vd import C3vdPoses, read_poses
from coliags_plugin.geometry.poses.endogslam import EndoGslamParams, image_indices
from coliags_plugin.geometry.poses.rigid import inverse, rigid, rotation_angles_deg

log = logging.getLogger(__name__)

PARAMS = "params.npz"
PoseSource = Literal["slam", "ground-truth"]

#: Largest difference of params.npz's true poses from pose.txt, mm and degrees. Rounding is a thousandth of this;
#: another sequence, or another order of frames, differs by millimetres.
SAME_SEQUENCE = 0.05
#: Ratio of the ATE to the spread of the cameras from which tracking counts as lost.
LOST = 0.2


@dataclass(frozen=True)
class PreparedFiles:
    """The files of one sequence, frame 0 first.

    ``params`` is EndoGSLAM's result, ``cloud`` the optimised Gaussians of PR-Endo's release.
    """

    folder: Path
    images: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: Path | None
    params: Path | None
    cloud: Path | None


@dataclass(frozen=True)
class SequencePoses:
    """The poses of a sequence in one world. Rigid, OpenCV axes, mm.

    ``from_slam`` and ``from_file`` transform from EndoGSLAM's world and from that of pose.txt; None without the file.
    """

    camera_to_world: Float[np.ndarray, "N 4 4"]
    from_slam: Float[np.ndarray, "4 4"] | None
    from_file: Float[np.ndarray, "4 4"] | None
    facts: Mapping[str, Any]


@dataclass(frozen=True)
class _Slam:
    """EndoGSLAM's trajectory aligned with the true one.

    ``indices`` are the image indices of its F poses; ``from_true`` transforms from the true poses, relative to their
    first camera, to EndoGSLAM's world.
    """

    params: EndoGslamParams
    path: Path
    indices: Int[np.ndarray, "F"]
    from_true: Float[np.ndarray, "4 4"]
    facts: Mapping[str, Any]


def load_poses(files: PreparedFiles, params: EndoGslamParams | None, source: PoseSource) -> SequencePoses:
    """Load the poses of a sequence's images; ``params`` are the contents of ``files.params``.

    ``slam``: EndoGSLAM's poses, in its world; images it did not track get their true poses, transformed to it.
    ``ground-truth``: the true poses, in the world of pose.txt, or without it of the first camera.
    """
    count = len(files.images)
    file = None if files.poses is None else read_poses(files.poses)
    if file is not None and files.poses is not None:
        check_pose_count(files.poses, len(file.camera_to_world), count)
    slam = None if params is None or files.params is None else _align_slam(files.params, params, files, file)
    facts: dict[str, Any] = {
        "poses": source,
        "pose_convention": None if file is None else {"order": file.convention, **file.evidence},
        "slam": None if slam is None else slam.facts,
    }
    if source == "slam":
        return _mapped(files, slam, file, facts)
    if file is not None:
        from_slam = None if slam is None else file.camera_to_world[0] @ _inverse(slam.from_true)
        return SequencePoses(file.camera_to_world, from_slam, np.eye(4), {**facts, "world": "pose.txt"})
    if slam is not None and len(slam.indices) == count:
        from_slam = _inverse(slam.from_true)
        return SequencePoses(slam.params.true_camera_to_world, from_slam, None, {**facts, "world": "first camera"})
    raise InputError(
        f"{files.folder} has no pose.txt" + ("" if slam is None else f", and {slam.path} no poses of test images"),
        "a true pose for every image",
        "Put the sequence's pose.txt of C3VD's release there",
    )


def _mapped(
    files: PreparedFiles, slam: _Slam | None, file: C3vdPoses | None, facts: Mapping[str, Any]
) -> SequencePoses:
    """Poses in EndoGSLAM's world."""
    if slam is None:
        raise InputError(
            f"{files.folder} has no {PARAMS}, in it or where PR-Endo's release has it",
            "EndoGSLAM's result, for option poses: slam",
            "Name it with --set datamanager.params_file=FILE, or --set datamanager.poses=ground-truth",
        )
    from_file = None if file is None else slam.from_true @ _inverse(file.camera_to_world[0])
    camera_to_world = slam.params.camera_to_world
    if len(slam.indices) < len(files.images):
        if file is None or from_file is None:
            raise InputError(
                f"{slam.path} has poses of {len(slam.indices)} of {len(files.images)} images, the training frames, "
                f"and {files.folder} no pose.txt for the others",
                "a pose for every image",
                "Put the sequence's pose.txt of C3VD's release there",
            )
        camera_to_world = from_file @ file.camera_to_world
        camera_to_world[slam.indices] = slam.params.camera_to_world
    return SequencePoses(camera_to_world, np.eye(4), from_file, {**facts, "world": "first camera, as mapped"})


def _align_slam(path: Path, params: EndoGslamParams, files: PreparedFiles, file: C3vdPoses | None) -> _Slam:
    count, poses = len(files.images), len(params.camera_to_world)
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
        compared = _compared(path, params.true_camera_to_world, true, indices, files.poses)
    from_true = _rigid_alignment(params.true_camera_to_world, params.camera_to_world)
    aligned = from_true @ params.true_camera_to_world
    errors = np.linalg.norm(aligned[:, :3, 3] - params.camera_to_world[:, :3, 3], axis=1)
    angles = _angles(aligned, params.camera_to_world)
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
        "other_images": None if poses == count else "true poses, brought into the mapped world by a rigid fit",
        "compared_with_pose_file": compared,
        "ate_rmse_mm": ate,
        "ate_max_mm": float(errors.max()),
        "mean_rotation_error_deg": float(angles.mean()),
    }
    return _Slam(params, path, indices, from_true, facts)


def _compared(
    path: Path,
    stored: Float[np.ndarray, "F 4 4"],
    true: Float[np.ndarray, "F 4 4"],
    indices: Int[np.ndarray, "F"],
    pose_file: Path | None,
) -> dict[str, float]:
    """Largest differences between the true poses of params.npz and pose.txt."""
    distances = np.linalg.norm(stored[:, :3, 3] - true[:, :3, 3], axis=1)
    angles = _angles(stored, true)
    worst = int(np.argmax(np.maximum(distances, angles)))
    if max(distances[worst], angles[worst]) > SAME_SEQUENCE:
        raise InputError(
            f"{path}: the true pose of image {indices[worst]} is {distances[worst]:.3g} mm and "
            f"{angles[worst]:.3g} degrees from that of {pose_file}",
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


def _angles(first: Float[np.ndarray, "F 4 4"], second: Float[np.ndarray, "F 4 4"]) -> Float[np.ndarray, "F"]:
    return rotation_angles_deg(first[:, :3, :3] @ second[:, :3, :3].transpose(0, 2, 1))


def _inverse(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    return inverse(matrix[None])[0]
