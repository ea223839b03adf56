"""Frames as a COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from coliags_plugin.core.scenes import Frame
from coliags_plugin.poses.rigid import inverse

if TYPE_CHECKING:
    import pycolmap


def colmap_cameras(frames: Sequence[Frame]) -> tuple[list[pycolmap.Camera], list[int]]:
    """The pinhole cameras of frames, each once, and which of them took each frame."""
    import pycolmap

    kinds: dict[tuple[float, ...], int] = {}
    which = []
    for frame in frames:
        camera = frame.camera
        kind = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        which.append(kinds.setdefault(kind, len(kinds)))
    cameras = [
        pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params) for width, height, *params in kinds
    ]
    return cameras, which


def posed_model(frames: Sequence[Frame], names: Sequence[str] | None = None) -> pycolmap.Reconstruction:
    """A model of posed pictures without points: frame i is image i + 1.

    Args:
        frames: Their poses and cameras.
        names: Of the pictures; None: ``0.png``, ``1.png``, ...
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    cameras, which = colmap_cameras(frames)
    for number, camera in enumerate(cameras, start=1):
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
    poses = np.stack([frame.camera.camera_to_world.cpu().double().numpy() for frame in frames])
    for index, world_to_camera in enumerate(inverse(poses)):
        image = pycolmap.Image(
            name=f"{index}.png" if names is None else names[index], camera_id=which[index] + 1, image_id=index + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_to_camera[:3]))
    return model
