"""PR-Endo's release of C3VD with EndoGSLAM's results (docs/layouts/c3vd-endogslam.md 2)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.c3vd_endogslam.files import OPTIMIZED, PARAMS
from coliags_plugin.datamanagers.c3vd_endogslam.writer import write_frame, write_gaussians, write_params
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, WallPoints, pinhole_of
from coliags_plugin.phantom.layouts.endogslam import EndoGSLAMLayout

_DATA, _SCENE, _ITERATION = "C3VD", "phantom", 30_000


class PREndoLayout(Layout):
    """C3VD/phantom without poses, and the result of an ideal EndoGSLAM run on all frames, also as a 3DGS PLY."""

    default_size = EndoGSLAMLayout.default_size
    has_points = True

    def is_test(self, index: int) -> bool:
        """PR-Endo's: 7, 15, 23, ..."""
        return EndoGSLAMLayout().is_test(index)

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """As in EndoGSLAM's layout."""
        return EndoGSLAMLayout().lens(width, height)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_frame(folder / _DATA / _SCENE, frame.index, frame.color, frame.z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`; poses are in params.npz."""

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """See :class:`Layout`."""
        results = folder / f"{_DATA}{OPTIMIZED}" / _SCENE
        found = Trajectory(np.stack(poses), intrinsics=pinhole_of(lens))
        means = write_params(results / PARAMS, found, points.positions, points.colors)
        write_gaussians(results / "point_cloud" / f"iteration_{_ITERATION}" / "point_cloud.ply", means, points.colors)

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """In the scene's folder, beside the images."""
        return super().seen_mask(folder / _DATA / _SCENE, part, index)
