"""Writes C3VD in EndoGSLAM's layout, with EndoGSLAM's and 3DGS's results (docs/layouts/c3vd-endogslam.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.core.arrays import read_arrays
from coliags_plugin.core.files import write_arrays
from coliags_plugin.core.images import write_image
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.datamanagers.c3vd_endogslam.reader import PREPARED_DEPTH, SH0
from coliags_plugin.geometry.poses import endogslam
from coliags_plugin.geometry.poses.rigid import inverse
from coliags_plugin.geometry.poses.trajectory import Trajectory

#: Standard deviation of the map's Gaussians, scene units (mm).
_SIZE = 0.3


def write_frame(folder: Path, index: int, image: UInt8[np.ndarray, "H W 3"], z_depth: Float[np.ndarray, "H W"]) -> None:
    """Write an image and its depth in 8 bits, rounded down like EndoGSLAM's script.

    Args:
        folder: Folder of the sequence.
        index: Index of the frame, from 0.
        image: RGB. [H, W, 3]
        z_depth: mm; 0 where unknown. [H, W]
    """
    steps = np.clip(np.floor(z_depth / PREPARED_DEPTH.size), 0.0, 255.0).astype(np.uint8)
    write_image(folder / "color" / f"{index:04d}_color.png", image)
    write_image(folder / "depth" / f"{index:04d}_depth.tiff", steps)


def write_params(
    path: Path, trajectory: Trajectory, positions: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 3"]:
    """Write ``params.npz`` like EndoGSLAM, with given poses and an isotropic Gaussian at every point.

    Args:
        path: The file.
        trajectory: Poses, mm, with intrinsics; the first camera defines EndoGSLAM's world.
        positions: Points of the map, world frame, mm. [N, 3]
        colors: RGB. [N, 3]

    Returns:
        The map's points in EndoGSLAM's world, mm. [N, 3]

    Raises:
        InputError: The trajectory has no intrinsics, or the folder cannot be written.
    """
    endogslam.write(path, trajectory)
    arrays = read_arrays(path, "what was just written", optional=None)
    to_first = inverse(trajectory.camera_to_world[:1])[0]
    means = positions @ to_first[:3, :3].T + to_first[:3, 3]
    count = len(means)
    arrays |= {
        "means3D": means.astype(np.float32),
        "rgb_colors": (colors / 255.0).astype(np.float32),
        "unnorm_rotations": np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1)),
        "logit_opacities": np.full((count, 1), 4.0, np.float32),
        "log_scales": np.full((count, 1), np.log(_SIZE), np.float32),
        "timestep": np.zeros(count, np.float32),
    }
    write_arrays(path, arrays)
    return np.asarray(means)


def write_gaussians(path: Path, positions: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"]) -> None:
    """Write isotropic Gaussians of equal size as a 3DGS PLY file of spherical-harmonics degree 0.

    Args:
        path: The file.
        positions: Means, in the world of ``params.npz``, mm. [N, 3]
        colors: RGB. [N, 3]
    """
    count = len(positions)
    properties = point_properties(positions)
    properties |= {f"n{name}": np.zeros(count) for name in "xyz"}
    properties |= {f"f_dc_{channel}": (colors[:, channel] / 255.0 - 0.5) / SH0 for channel in range(3)}
    properties |= {"opacity": np.full(count, 4.0)}
    properties |= {f"scale_{axis}": np.full(count, -1.2) for axis in range(3)}
    properties |= {f"rot_{axis}": np.full(count, float(axis == 0)) for axis in range(4)}
    write_ply(path, properties)
