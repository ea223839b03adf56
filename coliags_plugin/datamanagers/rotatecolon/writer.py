"""Writes RotateColon's layout: Blender's views and EXR depth (docs/layouts/rotatecolon.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import make_folder, write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.datamanagers.rotatecolon.files import POINTS, TEST, TRAIN, TRAIN_DEPTH, TRAIN_VIEWS
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z

TEST_VIEWS = "test_views_1"
#: Stored depth per mm, as in the dataset, and Blender's depth of the background.
_DEPTH_FACTOR, _BACKGROUND = 1.4, 1e10


def write_view(folder: Path, index: int, image: UInt8[np.ndarray, "H W 3"], z_depth: Float[np.ndarray, "H W"]) -> None:
    """Write a training view.

    Args:
        folder: Folder of the scene.
        index: Index of the view, from 0.
        image: RGB. [H, W, 3]
        z_depth: mm; 0 where there is no wall. [H, W]
    """
    write_image(folder / TRAIN_VIEWS / f"{index:04d}.png", image)
    stored = np.where(z_depth > 0.0, z_depth * _DEPTH_FACTOR, _BACKGROUND).astype(np.float32)
    _write_exr(folder / TRAIN_DEPTH / f"{index:04d}.exr", image, stored)


def write_test_view(folder: Path, index: int, image: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write a test view, which has no depth; arguments as for :func:`write_view`."""
    write_image(folder / TEST_VIEWS / f"{index:04d}.png", image)


def write_transforms(folder: Path, camera_to_world: Float[np.ndarray, "N 4 4"], angle: float, test: bool) -> None:
    """Write the JSON of the training or of the test views.

    Args:
        folder: Folder of the scene.
        camera_to_world: OpenCV axes, mm. [N, 4, 4]
        angle: Horizontal field of view, radians.
        test: Whether they are the test views.
    """
    frames = [
        {"file_path": str(index), "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist()}
        for index, pose in enumerate(camera_to_world)
    ]
    write_json(folder / (TEST if test else TRAIN), {"camera_angle_x": angle, "frames": frames})


def write_points(folder: Path, positions: Float[np.ndarray, "N 3"], colors: UInt8[np.ndarray, "N 3"]) -> None:
    """Write the initial points: world frame, mm, and RGB. Both [N, 3]"""
    write_ply(folder / POINTS, point_properties(positions, colors))


def _write_exr(path: Path, image: UInt8[np.ndarray, "H W 3"], depth: Float[np.ndarray, "H W"]) -> None:
    """Write an EXR file with Blender's channel names."""
    import OpenEXR

    linear = ((image / 255.0) ** 2.2).astype(np.float16)
    channels = {f"ViewLayer.Combined.{name}": linear[..., channel].copy() for channel, name in enumerate("RGB")}
    channels["ViewLayer.Combined.A"] = np.ones(depth.shape, np.float16)
    channels["ViewLayer.Depth.Z"] = depth
    make_folder(path.parent)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, channels).write(str(path))
    except RuntimeError as error:  # the only error it knows, of a full disk too
        raise InputError(f"cannot write {path}: {error}", "a writable folder with space left") from error
