"""C3VD as EndoGSLAM prepares it, with what EndoGSLAM would find (docs/layouts/c3vd-endogslam.md 1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.datamanagers.c3vd_endogslam.files import PARAMS
from coliags_plugin.datamanagers.c3vd_endogslam.manager import PREPARED_DEPTH, PREPARED_PINHOLE, PREPARED_SIZE
from coliags_plugin.lenses.models import Lens
from coliags_plugin.lenses.pinhole import PinholeLens
from coliags_plugin.phantom.layouts.base import Layout, Part, WallPoints, pinhole_of, place
from coliags_plugin.phantom.layouts.c3vd_raw import write_poses
from coliags_plugin.phantom.layouts.pictures import write_image
from coliags_plugin.phantom.trajectory import TEST_EVERY
from coliags_plugin.poses import endogslam
from coliags_plugin.poses.rigid import inverse
from coliags_plugin.poses.trajectory import Trajectory

#: Standard deviation of the map's Gaussians, mm.
_SIZE = 0.3


class EndoGSLAMLayout(Layout):
    """color/, 8-bit depth/, pose.txt, and params.npz of a flawless EndoGSLAM run on the training frames."""

    default_size = PREPARED_SIZE
    has_rotation = True
    has_points = True

    def is_test(self, index: int) -> bool:
        """EndoGSLAM's: 7, 15, 23, ..."""
        return index % TEST_EVERY == TEST_EVERY - 1

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The camera that EndoGSLAM takes undistorted frames for, stretched to the size. All pixels are lit."""
        pinhole = PREPARED_PINHOLE.scaled(width / PREPARED_SIZE[0], height / PREPARED_SIZE[1])
        return PinholeLens.of(pinhole, width, height), np.ones((height, width), bool)

    def write_frame(
        self,
        folder: Path,
        part: Part,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_prepared_frame(place(folder, part), index, color, z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(place(folder, part) / "pose.txt", poses)

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """See :class:`Layout`."""
        training = [pose for index, pose in enumerate(poses) if not self.is_test(index)]
        write_params(folder / PARAMS, points, training, lens)


def write_prepared_frame(
    folder: Path, index: int, color: UInt8[np.ndarray, "H W 3"], z_depth: Float[np.ndarray, "H W"]
) -> None:
    """A picture and its depth, in 8 bits, cut off below as EndoGSLAM's script does it."""
    steps = np.clip(np.floor(z_depth / PREPARED_DEPTH.size), 0.0, 255.0).astype(np.uint8)
    write_image(folder / "color" / f"{index:04d}_color.png", color)
    write_image(folder / "depth" / f"{index:04d}_depth.tiff", steps)


def write_params(
    path: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
) -> Float[np.ndarray, "N 3"]:
    """EndoGSLAM's result, had it found the true poses and the wall.

    Args:
        path: Of the ``params.npz``.
        points: What becomes the map.
        poses: Of the frames it was given; their first is its world. Each [4, 4]
        lens: Of all frames; a pinhole.

    Returns:
        The map's points in its world, mm. [N, 3]
    """
    endogslam.write(path, Trajectory(np.stack(poses), intrinsics=pinhole_of(lens)))
    with np.load(path) as file:
        arrays = dict(file)
    count = len(points.positions)
    to_first = inverse(poses[0][None])[0]
    means = points.positions @ to_first[:3, :3].T + to_first[:3, 3]
    arrays |= {
        "means3D": means.astype(np.float32),
        "rgb_colors": (points.colors / 255.0).astype(np.float32),
        "unnorm_rotations": np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1)),
        "logit_opacities": np.full((count, 1), 4.0, np.float32),
        "log_scales": np.full((count, 1), np.log(_SIZE), np.float32),
        "timestep": np.zeros(count, np.float32),
    }
    np.savez(path, allow_pickle=False, **arrays)
    return np.asarray(means)
