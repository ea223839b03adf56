"""Cameras of training frames as a run sees them."""

from __future__ import annotations

import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.trained import TrainedRun


def adjusted_camera(trained: TrainedRun, frame: Frame) -> Camera:
    """Camera of a training frame, as the run's view modules adjust it, float32 on the run's device."""
    camera = frame.camera.to(trained.device)
    for module in trained.model.view_modules.values():
        camera = module.adjust_camera(camera, frame.view(trained=True))
    return camera.to(dtype=torch.float32)
