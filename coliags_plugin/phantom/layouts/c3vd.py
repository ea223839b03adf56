"""C3VD's undistorted layout (docs/layouts/c3vd.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.reading.depth_formats import C3VD_DEPTH
from coliags_plugin.datamanagers.reading.files import write_camera_json
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.poses.c3vd import matrix_lines
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, part_folder

#: 100 mm in 16 bits.
_STEPS_PER_MM = 65535.0 / 100.0


class C3VDLayout(Layout):
    """Undistorted frames in ColIAGS's layout: images/, depths/, camera_pose.txt, camera.json."""

    has_rotation = True

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        folder = part_folder(folder, frame.part)
        write_image(folder / "images" / f"{frame.index:04d}_color.png", frame.color)
        write_image(folder / "depths" / f"{frame.index:04d}_depth.png", depth_steps(frame.z_depth))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        folder = part_folder(folder, part)
        write_poses(folder / "camera_pose.txt", poses)
        write_camera_json(folder / "camera.json", lens.pinhole, h=lens.height, w=lens.width)


def write_poses(path: Path, camera_to_world: Float[np.ndarray, "N 4 4"]) -> None:
    """Write a pose file with the release's nine digits; OpenCV axes, mm."""
    atomic_write(path, matrix_lines(camera_to_world, digits=9))


def depth_steps(z_depth: Float[np.ndarray, "H W"]) -> UInt16[np.ndarray, "H W"]:
    """z-depth, mm, in C3VD's encoding: 65535 / 100 steps per mm, 0 where unknown, 65535 from 100 mm on."""
    known = np.isfinite(z_depth) & (z_depth > 0.0)
    steps = np.rint(np.where(known, z_depth, 0.0) * _STEPS_PER_MM)
    return np.where(known, np.clip(steps, 1, C3VD_DEPTH.far), 0).astype(np.uint16)
