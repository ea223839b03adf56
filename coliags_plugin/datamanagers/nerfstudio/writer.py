"""Writes nerfstudio's layout with OpenCV's lens model (docs/layouts/nerfstudio.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import write_image
from coliags_plugin.geometry.lenses.opencv import OpenCVLens
from coliags_plugin.geometry.poses.rigid import FLIP_Y_AND_Z


def write_frame(
    folder: Path, index: int, image: UInt8[np.ndarray, "H W 3"], z_depth: Float[np.ndarray, "H W"], depth_unit: float
) -> None:
    """Write a frame.

    Args:
        folder: Folder of the scene.
        index: Index of the frame, from 0.
        image: RGB, as the lens shows it. [H, W, 3]
        z_depth: Scene units; 0 where unknown. [H, W]
        depth_unit: Scene units per 16-bit step.
    """
    write_image(folder / "images" / _name(index), image)
    steps = np.rint(z_depth / depth_unit).clip(0.0, 65535.0)
    write_image(folder / "depth" / _name(index), steps.astype(np.uint16))


def write_transforms(
    folder: Path, camera_to_world: Float[np.ndarray, "N 4 4"], lens: OpenCVLens, depth_unit: float
) -> None:
    """Write ``transforms.json``.

    Args:
        folder: Folder of the scene.
        camera_to_world: OpenCV axes, scene units. [N, 4, 4]
        lens: Of all frames, at their size, with radial terms up to k2.
        depth_unit: As for :func:`write_frame`.
    """
    frames = [
        {
            "file_path": f"images/{_name(index)}",
            "depth_file_path": f"depth/{_name(index)}",
            "transform_matrix": (pose @ FLIP_Y_AND_Z).tolist(),
        }
        for index, pose in enumerate(camera_to_world)
    ]
    k = lens.pinhole
    camera = {"camera_model": "OPENCV", "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy}
    size = {"w": lens.width, "h": lens.height}
    bends = {"k1": lens.k1, "k2": lens.k2, "p1": lens.p1, "p2": lens.p2}
    unit = {"depth_unit_scale_factor": depth_unit}
    write_json(folder / "transforms.json", {**camera, **size, **bends, **unit, "frames": frames})


def _name(index: int) -> str:
    return f"frame_{index + 1:05d}.png"
