"""C3VDv2's layout (docs/layouts/c3vd-v2.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.datamanagers.c3vd_v2.files import INTRINSICS
from coliags_plugin.datamanagers.c3vd_v2.lens import CANDIDATE_LENS, ORDER
from coliags_plugin.lenses.models import Lens, octagon_mask
from coliags_plugin.phantom.layouts.base import Layout, Part, place
from coliags_plugin.phantom.layouts.c3vd_raw import encode_depth, encode_normals, write_poses
from coliags_plugin.phantom.layouts.pictures import write_image


class C3VDv2Layout(Layout):
    """Distorted frames with black corners in folders by kind, pose.txt, and the lens in camera_intrinsics.txt."""

    default_size = (1350, 1080)
    has_rotation = True
    has_coverage_mesh = True

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The candidate for C3VDv2's lens, behind C3VD's octagonal mask."""
        return CANDIDATE_LENS.scaled(width, height), octagon_mask(width, height)

    def write_frame(
        self,
        folder: Path,
        part: Part,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`."""
        write_image(place(folder, part) / "rgb" / f"{index:04d}.png", color)
        write_image(place(folder, part) / "depth" / f"{index:04d}_depth.tiff", encode_depth(z_depth))
        write_image(place(folder, part) / "normals" / f"{index:04d}_normals.tiff", encode_normals(normals))

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`. The lens is described at the size it is calibrated for."""
        write_poses(place(folder, part) / "pose.txt", poses)
        values = {"a1": 0.0, **vars(CANDIDATE_LENS)}
        (folder / INTRINSICS).write_text("".join(f"{name} = {values[name]!r}\n" for name in ORDER))
