"""RotateColon's layout (docs/layouts/rotatecolon.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.rotatecolon.writer import write_points, write_test_view, write_transforms, write_view
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.lenses.pinhole import PinholeLens
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, WallPoints

#: Horizontal field of view, radians: that of C3VD's undistorted frames.
_ANGLE = 2.0 * math.atan(169.0 / 200.8769)


class RotateColonLayout(Layout):
    """Blender's files: training views with EXR depth, and rotated test views without depth."""

    has_rotation = True
    has_points = True

    def is_test(self, index: int) -> bool:
        """Never: the test views are the rotation views."""
        return False

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """Square pixels, the principal point in the middle. All pixels are lit."""
        focal = 0.5 * width / math.tan(0.5 * _ANGLE)
        lens = PinholeLens(focal, focal, 0.5 * width, 0.5 * height, width, height)
        return lens, np.ones((height, width), bool)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; normals are not part of this layout, nor is the depth of test views."""
        if frame.part == "rotation":
            write_test_view(folder, frame.index, frame.color)
        else:
            write_view(folder, frame.index, frame.color, frame.z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_transforms(folder, np.stack(poses), _ANGLE, test=part == "rotation")

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """See :class:`Layout`."""
        write_points(folder, points.positions, points.colors)

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """In ``truth/``: the dataset has no seen masks."""
        return folder / "truth" / "seen" / f"{index:04d}_seen.png"
