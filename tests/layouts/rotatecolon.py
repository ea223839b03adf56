"""RotateColon's layout: Blender's views and EXR depth (docs/layouts/rotatecolon.md)."""

from __future__ import annotations

import math

import numpy as np
import OpenEXR

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.scene_files import write_unit
from coliags_plugin.datamanagers.rotatecolon import POINTS, TEST, TRAIN, TRAIN_DEPTH, TRAIN_VIEWS
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.geometry.poses.trajectory import FLIP_Y_AND_Z
from coliags_plugin.phantom.layouts import Layout

_TEST_VIEWS = "test_views_1"
#: Stored depth per mm, as in the dataset, and Blender's depth of the background.
_DEPTH_FACTOR, _BACKGROUND = 1.4, 1e10
#: Horizontal field of view, radians: that of C3VD's undistorted frames.
_ANGLE = 2.0 * math.atan(169.0 / 200.8769)


class RotateColonLayout(Layout):
    """Blender's files: training views with EXR depth, and rotated test views without depth."""

    name = "rotatecolon"
    has_rotation = True
    has_points = True

    def is_test(self, index):
        """Never: the test views are the rotation views."""
        return False

    def lens(self, width, height):
        """Square pixels, the principal point in the middle. All pixels are lit."""
        focal = 0.5 * width / math.tan(0.5 * _ANGLE)
        lens = PinholeLens(focal, focal, 0.5 * width, 0.5 * height, width, height)
        return lens, np.ones((height, width), bool)

    def write_frame(self, folder, frame):
        views = _TEST_VIEWS if frame.part == "rotation" else TRAIN_VIEWS
        write_image(folder / views / f"{frame.index:04d}.png", frame.color)
        if frame.part == "video":
            linear = ((frame.color / 255.0) ** 2.2).astype(np.float16)
            channels = {f"ViewLayer.Combined.{name}": linear[..., at].copy() for at, name in enumerate("RGB")}
            channels["ViewLayer.Combined.A"] = np.ones(frame.z_depth.shape, np.float16)
            depth = np.where(frame.z_depth > 0.0, frame.z_depth * _DEPTH_FACTOR, _BACKGROUND).astype(np.float32)
            write_exr(folder / TRAIN_DEPTH / f"{frame.index:04d}.exr", {**channels, "ViewLayer.Depth.Z": depth})

    def write_sequence(self, folder, part, poses, lens):
        frames = [
            {"file_path": str(index), "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist()}
            for index, pose in enumerate(poses)
        ]
        write_json(folder / (TEST if part == "rotation" else TRAIN), {"camera_angle_x": _ANGLE, "frames": frames})
        write_unit(folder, "mm")

    def write_points(self, folder, points, poses, lens):
        write_ply(folder / POINTS, point_properties(points.positions, points.colors))

    def seen_mask(self, folder, part, index):
        """Path in ``truth/``, since the dataset has no seen masks."""
        return folder / "truth" / "seen" / f"{index:04d}_seen.png"


def write_exr(path, channels):
    """Write float channels [H, W] by their full names."""
    path.parent.mkdir(parents=True, exist_ok=True)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
