"""The frames of a scene as they were recorded: through the lens of the stored images, not undistorted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, UInt8

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.datamanagers.reading.images import read_mask
from coliags_plugin.datamanagers.recording import Shot
from coliags_plugin.datamanagers.stored_frames import StoredFrame
from coliags_plugin.geometry.lenses.pinhole import PinholeLens
from coliags_plugin.surface.coverage.views import CoverageView


def recorded_views(scene: Scene) -> list[CoverageView]:
    """Views of all frames of the video, held out or not, in its order.

    Raises:
        InputError: The unit of length is unknown, or there are fewer than two frames.
    """
    if not scene.is_metric:
        raise InputError(
            f"the unit of length of scene '{scene.name}' is unknown, and coverage is in mm",
            "a scene in mm",
            "Scale its poses to mm, for instance by a known diameter of the lumen",
        )
    if len(scene.video) < 2:
        raise InputError(f"scene '{scene.name}' has {len(scene.video)} frame", "two frames or more")
    return [_view(frame) for frame in scene.video]


def _view(frame: Frame) -> CoverageView:
    if isinstance(frame, StoredFrame):
        return _stored_view(frame.shot)
    camera = frame.camera
    mask = None if frame.mask is None else frame.mask.numpy()
    pose = camera.camera_to_world.double().numpy()
    return CoverageView(frame.name, pose, PinholeLens.of(camera.intrinsics), mask, frame.image.numpy)


def _stored_view(shot: Shot) -> CoverageView:
    rectification = shot.rectification
    pose = np.asarray(shot.camera_to_world, np.float64)
    return CoverageView(shot.name, pose, rectification.stored_lens, _content(shot), _reader(shot))


def _content(shot: Shot) -> Bool[np.ndarray, "H W"] | None:
    """Stored pixels that count: with image content and not masked out. [H, W]"""
    content = shot.rectification.stored_content
    if shot.mask is None:
        return content
    own = shot.rectification.checked(shot.mask, read_mask(shot.mask))
    return own if content is None else own & content


def _reader(shot: Shot) -> Callable[[], UInt8[np.ndarray, "H W 3"]]:
    return lambda: shot.rectification.checked(shot.image, read_rgb(shot.image))
