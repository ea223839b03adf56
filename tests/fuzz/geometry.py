"""Whether what was read is geometry: finite, and within the bounds that the package promises."""

from __future__ import annotations

import numpy as np
import torch

from coliags_plugin.core import bounds
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Scene

#: Poses of the worlds that readers convert between may grow by a rotation.
_LENGTH = 2.0 * bounds.LENGTH


class AbsurdError(Exception):
    """What was accepted is not finite, or absurd."""


def check_scene(scene: Scene) -> None:
    """Read all frames of a scene and check them.

    Raises:
        AbsurdError: A number is not finite or beyond the bounds.
    """
    for frame in [*scene.train, *(frame for frames in scene.test_sets.values() for frame in frames)]:
        where = f"frame {frame.name}"
        check_camera(frame.camera, where)
        size = (frame.camera.height, frame.camera.width)
        for what, pixels in (
            ("image", frame.image),
            ("depth", frame.depth),
            ("mask", frame.mask),
            ("seen", frame.seen),
        ):
            if pixels is not None and tuple(pixels.shape[:2]) != size:
                raise AbsurdError(f"{where}: {what} of {tuple(pixels.shape)} for {size}")
        if frame.depth is not None:
            known = frame.depth[~torch.isnan(frame.depth)]
            if len(known) and not (float(known.min()) > 0.0 and float(known.max()) <= _LENGTH):
                raise AbsurdError(f"{where}: depth from {known.min()} to {known.max()}")
    positions = scene.points.positions
    if len(positions) and not float(positions.abs().max()) <= _LENGTH:
        raise AbsurdError(f"points of {positions.abs().max()}")
    if not np.isfinite(scene.extent):
        raise AbsurdError(f"extent {scene.extent}")


def check_camera(camera: Camera, where: str) -> None:
    """Check pose and intrinsics of a camera.

    Raises:
        AbsurdError: See :func:`check_scene`.
    """
    inner = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    if not (np.isfinite(inner).all() and (inner[:2] > 0.0).all() and np.abs(inner).max() <= bounds.PIXELS):
        raise AbsurdError(f"{where}: intrinsics {inner}")
    if not (0 < camera.width <= bounds.IMAGE_SIDE and 0 < camera.height <= bounds.IMAGE_SIDE):
        raise AbsurdError(f"{where}: {camera.width} x {camera.height} pixels")
    check_poses(camera.camera_to_world[None].numpy(), where)


def check_poses(camera_to_world: np.ndarray, where: str = "poses") -> None:
    """Check poses. [N, 4, 4]

    Raises:
        AbsurdError: See :func:`check_scene`.
    """
    if not np.isfinite(camera_to_world.astype(np.float32)).all():
        raise AbsurdError(f"{where}: a pose that is not finite")
    rotation = camera_to_world[:, :3, :3].astype(np.float64)
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max()
    if error > 0.01 or np.abs(camera_to_world[:, :3, 3]).max() > _LENGTH:
        raise AbsurdError(f"{where}: R R^T - 1 = {error:g}, centres to {np.abs(camera_to_world[:, :3, 3]).max():g}")
