"""Runs whose model renders the truth, so that the mesh must be the true surface."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import torch

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import TrainedRun
from tests.scenes import wall_color, wall_scene

#: Place of the wall, and of a square in front of it, x and y from -2 to 2.
WALL, SQUARE = 20.0, 12.0


def depth_of(camera: Camera, square: bool) -> torch.Tensor:
    """True z-depth of the wall, perhaps with the square before it. [H, W]"""
    rays, center = camera.rays(), camera.center
    near = (SQUARE - center[2]) / rays[..., 2]
    hit = (center + near[..., None] * rays)[..., :2].abs().amax(-1) <= 2.0
    far = (WALL - center[2]) / rays[..., 2]
    return torch.where(hit, near, far) if square else far


class ExactModel:
    """Renders the wall; ``alpha`` wherever asked."""

    def __init__(self, square: bool = False, alpha: float = 1.0, depth: bool = True) -> None:
        self.square, self.alpha, self.depth = square, alpha, depth

    def check_outputs(self, wants, asking) -> None:
        if not self.depth:
            raise InputError(f"outputs needed by {asking}: {wants[-1]}", "some of alpha, rgb")

    def render(self, camera, wants=(), view=None):
        depth = depth_of(camera, self.square)
        rgb = wall_color(camera.center + depth[..., None] * camera.rays()).float()
        maps = {name: depth.float() for name in wants if name.startswith("depth")}
        return RenderOutput(rgb, torch.full_like(depth, self.alpha).float(), camera, maps)


def exact_run(frames: int = 17, square: bool = False, scene: Scene | None = None, **model) -> TrainedRun:
    """A run on the wall, 160x120, with such a model."""
    scene, place, config = scene or wall_scene(frames, 160, 120), RunFolder(Path("run")), SimpleNamespace()
    return TrainedRun(place, config, "exact", scene, ExactModel(square, **model), 100, torch.device("cpu"), 0, {})
