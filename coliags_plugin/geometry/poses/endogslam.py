"""Reads and writes EndoGSLAM's ``params.npz``: estimated poses, true poses and Gaussians.

Its world is the first camera of the sequence, its lengths are mm, its poses world-to-camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_arrays
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses.formats import Format, head, prefixed_errors
from coliags_plugin.geometry.poses.trajectory import (
    Trajectory,
    check_rigid,
    inverse,
    rigid,
    rotations_from_wxyz,
    wxyz_from_rotations,
)

#: Key -> shape, of at least one dimension; a letter is the same size throughout the file, F the number of poses.
SHAPES: dict[str, tuple[int | str, ...]] = {
    "cam_unnorm_rots": (1, 4, "F"),
    "cam_trans": (1, 3, "F"),
    "gt_w2c_all_frames": ("F", 4, 4),
    "intrinsics": (3, 3),
    "org_width": (1,),
    "org_height": (1,),
    "means3D": ("N", 3),
    "rgb_colors": ("N", 3),
}
_POSES = ("cam_unnorm_rots", "cam_trans")
_PINHOLE = ("intrinsics", "org_width", "org_height")
#: EndoGSLAM holds out frames 7, 15, 23, ... by default.
_HELD_OUT_EVERY = 8


@dataclass(frozen=True, eq=False)
class EndoGslamParams:
    """Contents of a ``params.npz``, in this package's conventions: the world is the first camera, lengths are mm."""

    camera_to_world: Float[np.ndarray, "F 4 4"]  # estimated poses, rigid, OpenCV axes
    true_camera_to_world: Float[np.ndarray, "F 4 4"]  # the data set's poses of the same frames in the same world
    intrinsics: Intrinsics  # of all images
    means: Float[np.ndarray, "N 3"]  # centres of the Gaussians; N may be 0. float64
    rgb_colors: Float[np.ndarray, "N 3"]  # colours, nominally in [0, 1]; may lie a little outside. float64


def read_params(path: Path) -> EndoGslamParams:
    """Read what is used of a ``params.npz``."""
    arrays = _arrays(path, tuple(SHAPES))
    return EndoGslamParams(
        camera_to_world=_estimate(path, arrays),
        true_camera_to_world=_truth(path, arrays),
        intrinsics=_intrinsics(path, arrays),
        means=arrays["means3D"],
        rgb_colors=arrays["rgb_colors"],
    )


def read(path: Path) -> Trajectory:
    """Read the estimated poses and the intrinsics."""
    arrays = _arrays(path, _POSES, optional=_PINHOLE)
    camera_to_world = _estimate(path, arrays)
    untouched = np.all(arrays["cam_trans"][0] == 0.0, axis=0) & np.all(arrays["cam_unnorm_rots"][0, 1:] == 0.0, axis=0)
    tail = len(untouched) - 1 - int(np.flatnonzero(~untouched)[-1]) if not untouched.all() else 0
    remarks = [f"the last {tail} poses are the identity: was the run stopped early?"] if tail > 1 else []
    return _trajectory(path, arrays, camera_to_world, "world-to-camera translations and quaternions, w first", remarks)


def read_truth(path: Path) -> Trajectory:
    """Read the dataset's true poses stored by EndoGSLAM."""
    arrays = _arrays(path, ("gt_w2c_all_frames",), optional=_PINHOLE)
    return _trajectory(path, arrays, _truth(path, arrays), "world-to-camera matrices", [])


def write(path: Path, trajectory: Trajectory) -> None:
    """Write a ``params.npz`` with poses and intrinsics, but no Gaussians.

    The world becomes the first camera, as the format requires. The trajectory is written as both estimated and true
    poses, since readers differ in which of them they use. Poses are float32, as EndoGSLAM's.
    """
    intrinsics = trajectory.needed_intrinsics(path, "a params.npz")
    # World to first camera, then first camera to each camera.
    world_to_camera = inverse(trajectory.camera_to_world) @ trajectory.camera_to_world[0]
    world_to_camera[0] = np.eye(4)
    quats_wxyz = wxyz_from_rotations(world_to_camera[:, :3, :3])
    arrays = {
        "cam_unnorm_rots": quats_wxyz.T[None].astype(np.float32),
        "cam_trans": world_to_camera[:, :3, 3].T[None].astype(np.float32),
        "gt_w2c_all_frames": world_to_camera.astype(np.float32),
        "w2c": np.eye(4, dtype=np.float32),
        "intrinsics": intrinsics.opencv_matrix().astype(np.float32),
        "org_width": np.array(intrinsics.width),
        "org_height": np.array(intrinsics.height),
        "means3D": np.zeros((0, 3), np.float32),
        "rgb_colors": np.zeros((0, 3), np.float32),
        "unnorm_rotations": np.zeros((0, 4), np.float32),
        "logit_opacities": np.zeros((0, 1), np.float32),
        "log_scales": np.zeros((0, 1), np.float32),
        "timestep": np.zeros((0,), np.float32),
        "keyframe_time_indices": np.zeros((0,), np.int64),
    }
    write_arrays(path, arrays)


def image_indices(poses: int, images: int) -> Int[np.ndarray, "F"] | None:
    """Image index of each of EndoGSLAM's poses: all, or all but 7, 15, 23, ...; None if the counts match neither. [F]

    EndoGSLAM's default config tracks only training frames, so that a file may hold 7/8 of the sequence's poses.
    """
    every = np.arange(images)
    if poses == images:
        return every
    training = every[every % _HELD_OUT_EVERY != _HELD_OUT_EVERY - 1]
    return training if poses == len(training) else None


def _trajectory(
    path: Path, arrays: dict[str, np.ndarray], camera_to_world: np.ndarray, stored_as: str, remarks: list[str]
) -> Trajectory:
    if missing := [key for key in _PINHOLE if key not in arrays]:
        intrinsics = None
        remarks = [*remarks, f"no intrinsics: the file has no {', '.join(missing)}"]
    else:
        intrinsics = _intrinsics(path, arrays)
    return Trajectory(camera_to_world, intrinsics=intrinsics, stored_as=stored_as, remarks=tuple(remarks))


def _intrinsics(path: Path, arrays: dict[str, np.ndarray]) -> Intrinsics:
    matrix = arrays["intrinsics"]
    fx, fy, cx, cy = (float(matrix[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    width, height = (int(arrays[key].item()) for key in ("org_width", "org_height"))
    # EndoGSLAM unprojects pixel u as (u - cx) / fx: its pixel centres are integers.
    with prefixed_errors(str(path)):
        return Intrinsics(fx, fy, cx + 0.5, cy + 0.5, width, height)


def _estimate(path: Path, arrays: dict[str, np.ndarray]) -> np.ndarray:
    quats_wxyz = arrays["cam_unnorm_rots"][0].T
    rotations = rotations_from_wxyz(quats_wxyz, lambda index: f"{path}, cam_unnorm_rots, frame {index}", unit=False)
    return inverse(rigid(rotations, arrays["cam_trans"][0].T))


def _truth(path: Path, arrays: dict[str, np.ndarray]) -> np.ndarray:
    world_to_camera = arrays["gt_w2c_all_frames"]
    check_rigid(world_to_camera, lambda index: f"{path}, gt_w2c_all_frames, frame {index}")
    return inverse(world_to_camera)


def _arrays(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Load the named arrays as float64 and check their shapes and values; optional ones if present."""
    arrays = read_arrays(path, "a params.npz written by EndoGSLAM", optional=(*required, *optional))
    faults = [f"no {key}" for key in required if key not in arrays]
    sizes: dict[str, int] = {}
    for key, array in list(arrays.items()):
        if fault := _fault(key, array, sizes):
            faults.append(fault)
        else:
            arrays[key] = array.astype(np.float64)
    if sizes.get("F") == 0:
        faults.append("no frames")
    if faults:
        raise InputError(
            f"{path}: {'; '.join(faults)}",
            "a params.npz as EndoGSLAM writes it at the end of a run",
            "Let EndoGSLAM finish, and give the params.npz of its working folder",
        )
    return arrays


def _fault(key: str, array: np.ndarray, sizes: dict[str, int]) -> str:
    """Describe the fault of an array, or return an empty string; records the sizes of letters."""
    if not (np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)):
        return f"{key} holds {array.dtype}, not numbers"
    shape, expected = np.atleast_1d(array).shape, [sizes.get(str(size), size) for size in SHAPES[key]]
    if len(shape) != len(expected) or any(
        isinstance(want, int) and want != have for want, have in zip(expected, shape, strict=True)
    ):
        return f"{key} has the shape {list(array.shape)}, not [{', '.join(map(str, expected))}]"
    sizes.update((size, have) for size, have in zip(SHAPES[key], shape, strict=True) if isinstance(size, str))
    return "" if np.all(np.isfinite(array)) else f"{key} holds numbers that are not finite"


_KEEPS = frozenset({"intrinsics"})
FORMAT = Format(
    "endogslam",
    read,
    write,
    lambda path: head(path).startswith(b"PK\x03\x04"),  # a ZIP archive, as NPZ files are
    unit="mm",
    keeps=_KEEPS,
)
TRUTH_FORMAT = Format("endogslam-truth", read_truth, None, None, unit="mm", keeps=_KEEPS)
