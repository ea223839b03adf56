"""C3VD's undistorted layout (docs/layouts/c3vd.md)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.lenses.models import Lens
from coliags_plugin.lenses.pinhole import PinholeLens
from coliags_plugin.phantom.layouts.base import Layout, Part, place
from coliags_plugin.phantom.layouts.c3vd_raw import encode_depth, write_poses
from coliags_plugin.phantom.layouts.pictures import write_image


class C3VDLayout(Layout):
    """Undistorted frames as ColIAGS reads them: images/, depths/, camera_pose.txt, camera.json."""

    has_rotation = True

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
        write_image(place(folder, part) / "images" / f"{index:04d}_color.png", color)
        write_image(place(folder, part) / "depths" / f"{index:04d}_depth.png", encode_depth(z_depth))

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(place(folder, part) / "camera_pose.txt", poses)
        write_camera_json(place(folder, part) / "camera.json", lens)


def write_camera_json(path: Path, lens: Lens, **more: float) -> None:
    """Intrinsics (pixel centres at integers) and picture size of pinhole lens, and whatever else is given."""
    if not isinstance(lens, PinholeLens):
        raise TypeError(f"{path.name} holds a pinhole camera")
    k = lens.pinhole
    camera = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "h": lens.height, "w": lens.width, **more}
    path.write_text(json.dumps(camera, indent=2) + "\n")
