"""C3VD's undistorted layout (docs/layouts/c3vd.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from coliags_plugin.datamanagers.c3vd.writer import CAMERA, POSES, write_frame, write_poses
from coliags_plugin.datamanagers.reading.camera_json import write_camera_json
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, part_folder


class C3VDLayout(Layout):
    """Undistorted frames in ColIAGS's layout: images/, depths/, camera_pose.txt, camera.json."""

    has_rotation = True

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        write_frame(part_folder(folder, frame.part), frame.index, frame.color, frame.z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(part_folder(folder, part) / POSES, poses)
        write_camera_json(part_folder(folder, part) / CAMERA, lens.pinhole, h=lens.height, w=lens.width)
