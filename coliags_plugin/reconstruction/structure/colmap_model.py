"""Converts posed frames to a COLMAP reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Frame
from coliags_plugin.geometry.poses.colmap import posed_model
from coliags_plugin.geometry.poses.rigid import inverse

if TYPE_CHECKING:
    import pycolmap


def frame_model(frames: Sequence[Frame], names: Sequence[str] | None = None) -> pycolmap.Reconstruction:
    """A reconstruction of posed frames without points: frame i is COLMAP's image i + 1, equal cameras are shared.

    Args:
        frames: Their poses and cameras.
        names: Image names; None: ``0.png``, ``1.png``, ...
    """
    import pycolmap

    camera_to_world = np.stack([frame.camera.camera_to_world.cpu().double().numpy() for frame in frames])
    names = [f"{index}.png" for index in range(len(frames))] if names is None else names
    cameras: dict[Intrinsics, int] = {}
    camera_indices = [cameras.setdefault(frame.camera.intrinsics, len(cameras)) for frame in frames]
    world_to_camera = [pycolmap.Rigid3d(matrix[:3]) for matrix in inverse(camera_to_world)]
    return posed_model(world_to_camera, names, list(cameras), camera_indices)
