"""nerfstudio's layout with a distorting lens (docs/layouts/nerfstudio.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.lenses.tabulated import OpenCVLens
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z
from coliags_plugin.phantom.layouts.base import Layout, Part, PhantomFrame

#: Millimetres per depth step: up to 655 mm.
DEPTH_UNIT = 0.01
#: A mild barrel distortion, so that missing undistortion is noticed.
_DISTORTION: dict[str, Any] = {"k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}


class NerfstudioLayout(Layout):
    """images/, depth/, unit.txt and a transforms.json with an OPENCV camera."""

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """The default camera with OpenCV's lens distortion."""
        plain, lit = super().lens(width, height)
        return OpenCVLens(**vars(plain.pinhole), **_DISTORTION), lit

    def write_frame(self, folder: Path, frame: PhantomFrame) -> None:
        """See :class:`Layout`."""
        write_image(folder / "images" / _name(frame.index), frame.color)
        steps = np.rint(frame.z_depth / DEPTH_UNIT).clip(0.0, 65535.0)
        write_image(folder / "depth" / _name(frame.index), steps.astype(np.uint16))

    def write_sequence(self, folder: Path, part: Part, poses: Float[np.ndarray, "N 4 4"], lens: Lens) -> None:
        """See :class:`Layout`."""
        frames = [
            {
                "file_path": f"images/{_name(index)}",
                "depth_file_path": f"depth/{_name(index)}",
                "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist(),
            }
            for index, pose in enumerate(poses)
        ]
        k = lens.pinhole
        content = {
            "camera_model": "OPENCV",
            **{"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": lens.width, "h": lens.height},
            **_DISTORTION,
            "depth_unit_scale_factor": DEPTH_UNIT,
            "frames": frames,
        }
        write_json(folder / "transforms.json", content)
        write_unit(folder, "mm")


def _name(index: int) -> str:
    return f"frame_{index + 1:05d}.png"
