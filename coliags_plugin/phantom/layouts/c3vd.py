"""C3VD's undistorted layout, its raw release, and C3VDv2 (docs/layouts/c3vd.md, docs/layouts/c3vd-v2.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.c3vd.writer import CAMERA, POSES, depth_steps, normal_steps, write_frame, write_poses
from coliags_plugin.datamanagers.c3vd_v2.lens import CANDIDATE_LENS, ORDER
from coliags_plugin.datamanagers.c3vd_v2.reader import INTRINSICS
from coliags_plugin.datamanagers.reading.camera_json import write_camera_json
from coliags_plugin.geometry.lenses.models import LENSES, Lens, octagon_mask
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame, part_folder


class C3VDLayout(Layout):
    """Undistorted frames in ColIAGS's layout: images/, depths/, camera_pose.txt, camera.json."""

    has_rotation = True

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`; normals are not part of this layout."""
        write_frame(part_folder(folder, frame.part), frame.index, frame.color, frame.z_depth)

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(part_folder(folder, part) / POSES, poses)
        write_camera_json(part_folder(folder, part) / CAMERA, lens.pinhole, h=lens.height, w=lens.width)


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
        folder, number = part_folder(folder, frame.part), f"{frame.index:04d}"
        write_image(folder / f"{number}_color.png", frame.color)
        write_image(folder / f"{number}_depth.tiff", depth_steps(frame.z_depth))
        write_image(folder / f"{number}_normals.tiff", normal_steps(frame.normals))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(part_folder(folder, part) / "pose.txt", poses)


class C3VDv2Layout(C3VDRawLayout):
    """Distorted frames with black corners in folders by kind, pose.txt, and the lens in camera_intrinsics.txt."""

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The candidate for C3VDv2's lens, behind C3VD's octagonal mask."""
        return CANDIDATE_LENS.resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        folder, number = part_folder(folder, frame.part), f"{frame.index:04d}"
        write_image(folder / "rgb" / f"{number}.png", frame.color)
        write_image(folder / "depth" / f"{number}_depth.tiff", depth_steps(frame.z_depth))
        write_image(folder / "normals" / f"{number}_normals.tiff", normal_steps(frame.normals))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`. The lens is described at the size it is calibrated for, pixel centres at integers."""
        super().write_sequence(folder, part, poses, lens)
        candidate = CANDIDATE_LENS
        values = {"a1": 0.0, **vars(candidate), "cx": candidate.cx - 0.5, "cy": candidate.cy - 0.5}
        atomic_write(folder / INTRINSICS, "".join(f"{name} = {values[name]!r}\n" for name in ORDER))
