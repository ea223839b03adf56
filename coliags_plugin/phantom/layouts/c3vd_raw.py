"""The layout of C3VD's raw release (docs/layouts/c3vd.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.c3vd.writer import write_poses, write_raw_frame
from coliags_plugin.geometry.lenses.models import LENSES, Lens, octagon_mask
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, part_folder


class C3VDRawLayout(Layout):
    """The release's files: distorted frames with black corners, TIFF depth and normals, pose.txt."""

    default_size = (1350, 1080)
    has_rotation = True
    has_coverage_mesh = True

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """C3VD's omnidirectional lens behind its octagonal mask."""
        return LENSES["omnidirectional"].resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        write_raw_frame(part_folder(folder, frame.part), frame.index, frame.color, frame.z_depth, frame.normals)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(part_folder(folder, part) / "pose.txt", np.stack(poses))
