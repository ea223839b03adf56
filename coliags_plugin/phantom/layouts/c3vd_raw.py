"""The layout of C3VD's own release (docs/layouts/c3vd.md), and how it stores depth, normals and poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.lenses.models import LENSES, Lens, octagon_mask
from coliags_plugin.phantom.layouts.base import Layout, Part, place
from coliags_plugin.phantom.layouts.pictures import write_image

#: z-depth that the largest 16-bit value stands for, mm; whatever is farther is clipped there.
DEPTH_RANGE = 100.0


class C3VDRawLayout(Layout):
    """The release's own files: distorted frames with black corners, TIFF depth and normals, pose.txt."""

    default_size = (1350, 1080)
    has_rotation = True
    has_coverage_mesh = True

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """C3VD's omnidirectional lens behind its octagonal mask."""
        return LENSES["omnidirectional"].scaled(width, height), octagon_mask(width, height)

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
        write_image(place(folder, part) / f"{index:04d}_color.png", color)
        write_image(place(folder, part) / f"{index:04d}_depth.tiff", encode_depth(z_depth))
        write_image(place(folder, part) / f"{index:04d}_normals.tiff", encode_normals(normals))

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        write_poses(place(folder, part) / "pose.txt", poses)


def encode_depth(z_depth: Float[np.ndarray, "H W"]) -> np.ndarray:
    """C3VD's 16 bits: 65535 / 100 a mm, 65535 from 100 mm on, 0 for none. [H, W]"""
    return np.clip(np.rint(z_depth * (65535.0 / DEPTH_RANGE)), 0.0, 65535.0).astype(np.uint16)


def encode_normals(normals: Float[np.ndarray, "H W 3"]) -> np.ndarray:
    """C3VD's 16 bits: -1 to 1 becomes 0 to 65535; 0, 0, 0 where there is no wall. [H, W, 3]"""
    encoded = np.rint((normals + 1.0) * (0.5 * 65535.0)).clip(0.0, 65535.0).astype(np.uint16)
    encoded[~normals.any(axis=-1)] = 0
    return encoded


def write_poses(path: Path, poses: Sequence[Float[np.ndarray, "4 4"]]) -> None:
    """One line a frame: camera-to-world, mm, 16 numbers column by column, as C3VD's release has them."""
    lines = (",".join(f"{value:.9g}" for value in pose.T.ravel()) for pose in poses)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
