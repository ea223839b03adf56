"""RotateColon's layout (docs/layouts/rotatecolon.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from coliags_plugin.datamanagers.rotatecolon.files import POINTS, TEST, TRAIN, TRAIN_DEPTH, TRAIN_VIEWS
from coliags_plugin.lenses.models import Lens, Pinhole
from coliags_plugin.lenses.pinhole import PinholeLens
from coliags_plugin.phantom.layouts.base import Layout, Part, WallPoints
from coliags_plugin.phantom.layouts.meshes import write_points
from coliags_plugin.phantom.layouts.pictures import write_image
from coliags_plugin.poses.rigid import FLIP_Y_AND_Z

_TEST_VIEWS = "test_views_1"
#: Horizontal field of view, radians: that of C3VD's undistorted frames.
_ANGLE = 2.0 * math.atan(169.0 / 200.8769)
#: Stored depth per mm, as in the data; and what Blender stores where a ray meets nothing.
_DEPTH_FACTOR, _NOTHING = 1.4, 1e10


class RotateColonLayout(Layout):
    """Blender's files: views and EXR depth to train on, turned views without depth to test on."""

    has_rotation = True
    has_points = True

    def is_test(self, index: int) -> bool:
        """None: the test views are the rotation views."""
        return False

    def lens(self, width: int, height: int) -> tuple[Lens, Bool[np.ndarray, "H W"]]:
        """Square pixels, the principal point in the middle. All pixels are lit."""
        focal = 0.5 * width / math.tan(0.5 * _ANGLE)
        pinhole = Pinhole(focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5)
        return PinholeLens.of(pinhole, width, height), np.ones((height, width), bool)

    def write_frame(
        self,
        folder: Path,
        part: Part,
        index: int,
        color: UInt8[np.ndarray, "H W 3"],
        z_depth: Float[np.ndarray, "H W"],
        normals: Float[np.ndarray, "H W 3"],
    ) -> None:
        """See :class:`Layout`; normals are not part of this layout, nor is the depth of test views."""
        if part == "rotation":
            write_image(folder / _TEST_VIEWS / f"{index:04d}.png", color)
            return
        write_image(folder / TRAIN_VIEWS / f"{index:04d}.png", color)
        stored = np.where(z_depth > 0.0, z_depth * _DEPTH_FACTOR, _NOTHING).astype(np.float32)
        _write_exr(folder / TRAIN_DEPTH / f"{index:04d}.exr", color, stored)

    def write_sequence(self, folder: Path, part: Part, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens) -> None:
        """See :class:`Layout`."""
        frames = [
            {"file_path": str(index), "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist()}
            for index, pose in enumerate(poses)
        ]
        content = {"camera_angle_x": _ANGLE, "frames": frames}
        (folder / (TRAIN if part == "video" else TEST)).write_text(json.dumps(content, indent=2) + "\n")

    def write_points(
        self, folder: Path, points: WallPoints, poses: Sequence[Float[np.ndarray, "4 4"]], lens: Lens
    ) -> None:
        """See :class:`Layout`."""
        write_points(folder / POINTS, points.positions, points.colors)

    def seen_mask(self, folder: Path, part: Part, index: int) -> Path:
        """In the truth: the data set itself has none."""
        return folder / "truth" / "seen" / f"{index:04d}_seen.png"


def _write_exr(path: Path, color: UInt8[np.ndarray, "H W 3"], depth: Float[np.ndarray, "H W"]) -> None:
    """Several channels, named as Blender names them."""
    import OpenEXR

    linear = ((color / 255.0) ** 2.2).astype(np.float16)
    channels = {f"ViewLayer.Combined.{name}": linear[..., place].copy() for place, name in enumerate("RGB")}
    channels["ViewLayer.Combined.A"] = np.ones(depth.shape, np.float16)
    channels["ViewLayer.Depth.Z"] = depth
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
