"""nerfstudio's layout, taken through a lens (docs/layouts/nerfstudio.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.core.files import write_json
from coliags_plugin.lenses.models import Lens
from coliags_plugin.lenses.opencv import OpenCVLens
from coliags_plugin.lenses.pinhole import PinholeLens
from coliags_plugin.phantom.layouts.base import Layout, Part
from coliags_plugin.phantom.layouts.pictures import write_image
from coliags_plugin.poses.rigid import FLIP_Y_AND_Z

#: Millimetres in a depth step: up to 655 mm.
DEPTH_UNIT = 0.01
#: A mild barrel, so that whoever forgets to undistort is found out.
_BENDS = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}


class NerfstudioLayout(Layout):
    """images/, depth/ and a transforms.json in millimetres with an OPENCV camera."""

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The usual camera, behind a lens that OpenCV's model describes."""
        plain, lit = super().lens(width, height)
        if not isinstance(plain, PinholeLens):
            raise TypeError("a lens needs a pinhole to stand before")
        fx, fy, cx, cy = plain.pinhole
        k1, k2, p1, p2 = _BENDS.values()
        return OpenCVLens(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, p1=p1, p2=p2), lit

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
        write_image(folder / "images" / _name(index), color)
        steps = np.rint(z_depth / DEPTH_UNIT).clip(0.0, 65535.0)
        write_image(folder / "depth" / _name(index), steps.astype(np.uint16))

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        if not isinstance(lens, OpenCVLens):
            raise TypeError("the nerfstudio layout is taken through OpenCV's lens")
        frames = [
            {
                "file_path": f"images/{_name(index)}",
                "depth_file_path": f"depth/{_name(index)}",
                "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist(),
            }
            for index, pose in enumerate(poses)
        ]
        k = lens.pinhole
        camera = {"camera_model": "OPENCV", "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx + 0.5, "cy": k.cy + 0.5}
        size = {"w": lens.width, "h": lens.height}
        unit = {"depth_unit_scale_factor": DEPTH_UNIT}
        write_json(folder / "transforms.json", {**camera, **size, **_BENDS, **unit, "frames": frames})


def _name(index: int) -> str:
    return f"frame_{index + 1:05d}.png"
