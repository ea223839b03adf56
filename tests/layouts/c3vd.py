"""C3VD's release and C3VDv2 (docs/layouts/c3vd.md, docs/layouts/c3vd-v2.md)."""

from __future__ import annotations

from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.c3vd import CANDIDATE_LENS, INTRINSICS, ORDER
from coliags_plugin.geometry.lenses.models import LENSES, octagon_mask
from coliags_plugin.phantom.layouts import Layout, depth_steps, part_folder, write_poses


class C3VDRawLayout(Layout):
    """The release's files: distorted frames with black corners, TIFF depth, pose.txt."""

    name = "c3vd-raw"
    default_size = (1350, 1080)
    has_rotation = True

    def lens(self, width, height):
        """C3VD's omnidirectional lens behind its octagonal mask."""
        return LENSES["omnidirectional"].resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder, frame):
        folder, number = part_folder(folder, frame.part), f"{frame.index:04d}"
        write_image(folder / f"{number}_color.png", frame.color)
        write_image(folder / f"{number}_depth.tiff", depth_steps(frame.z_depth))

    def write_sequence(self, folder, part, poses, lens):
        write_poses(part_folder(folder, part) / "pose.txt", poses)


class C3VDv2Layout(C3VDRawLayout):
    """Distorted frames with black corners in folders by kind, pose.txt, and the lens in camera_intrinsics.txt."""

    name = "c3vd-v2"

    def lens(self, width, height):
        """The candidate for C3VDv2's lens, behind C3VD's octagonal mask."""
        return CANDIDATE_LENS.resized(width, height), octagon_mask(width, height)

    def write_frame(self, folder, frame):
        folder, number = part_folder(folder, frame.part), f"{frame.index:04d}"
        write_image(folder / "rgb" / f"{number}.png", frame.color)
        write_image(folder / "depth" / f"{number}_depth.tiff", depth_steps(frame.z_depth))

    def write_sequence(self, folder, part, poses, lens):
        super().write_sequence(folder, part, poses, lens)
        candidate = CANDIDATE_LENS
        values = {"a1": 0.0, **vars(candidate), "cx": candidate.cx - 0.5, "cy": candidate.cy - 0.5}
        atomic_write(folder / INTRINSICS, "".join(f"{name} = {values[name]!r}\n" for name in ORDER))
