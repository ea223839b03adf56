"""C3VDv2's layout (docs/layouts/c3vd-v2.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.datamanagers.c3vd.writer import write_poses
from coliags_plugin.datamanagers.c3vd_v2.lens import CANDIDATE_LENS
from coliags_plugin.datamanagers.c3vd_v2.writer import write_frame, write_lens
from coliags_plugin.geometry.lenses.models import Lens, octagon_mask
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, part_folder


class C3VDv2Layout(Layout):
    """Distorted frames with black corners in folders by kind, pose.txt, and the lens in camera_intrinsics.txt."""

    default_size = (1350, 1080)
    has_rotation = True
    has_coverage_mesh = True

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The candidate for C3VDv2's lens, behind C3VD's octagonal mask."""
        return CANDIDATE_LENS.resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        write_frame(part_folder(folder, frame.part), frame.index, frame.color, frame.z_depth, frame.normals)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`. The lens is described at the size it is calibrated for."""
        write_poses(part_folder(folder, part) / "pose.txt", np.stack(poses))
        write_lens(folder, CANDIDATE_LENS)
