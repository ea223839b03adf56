"""EndoGSLAM's layout of C3VD with a simulated result of EndoGSLAM (docs/layouts/c3vd-endogslam.md 1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.c3vd.writer import write_poses
from coliags_plugin.datamanagers.c3vd_endogslam.files import PARAMS
from coliags_plugin.datamanagers.c3vd_endogslam.reader import PREPARED_PINHOLE
from coliags_plugin.datamanagers.c3vd_endogslam.writer import write_frame, write_params
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.lenses.pinhole import PinholeLens
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, WallPoints, part_folder, pinhole_of
from coliags_plugin.phantom.trajectory import TEST_EVERY


class EndoGSLAMLayout(Layout):
    """color/, 8-bit depth/, pose.txt, and params.npz of an ideal EndoGSLAM run on the training frames."""

    default_size = (PREPARED_PINHOLE.width, PREPARED_PINHOLE.height)
    has_rotation = True
    has_points = True

    def is_test(self, index: int) -> bool:
        """EndoGSLAM's: 7, 15, 23, ..."""
        return index % TEST_EVERY == TEST_EVERY - 1

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """EndoGSLAM's camera of undistorted frames, scaled to the size. All pixels are lit."""
        return PinholeLens.of(PREPARED_PINHOLE.resized(width, height)), np.ones((height, width), bool)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_frame(part_folder(folder, frame.part), frame.index, frame.color, frame.z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(part_folder(folder, part) / "pose.txt", np.stack(poses))

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """See :class:`Layout`."""
        training = [pose for index, pose in enumerate(poses) if not self.is_test(index)]
        found = Trajectory(np.stack(training), intrinsics=pinhole_of(lens))
        write_params(folder / PARAMS, found, points.positions, points.colors)
