"""Distillation of a run into explicit Gaussians: a fit to its frames and to its renderings between them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.contracts import log_linear
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import NotFiniteError
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.engine.held_light import mean_camera, render_held, splatting_of
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.samplers import generators
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians
from coliags_plugin.renderers.splatting import choose_renderer

#: Steps, one view each, that are taken where the time allows.
STEPS = 6000
#: Adam's rates by parameter group at the first step; centres' in pixels on the surface. At the last step they are
#: _LAST of that.
_RATES = {
    "means": 0.04,
    "scales": 0.03,
    "quats": 0.016,
    "opacities": 0.1,
    "sh0": 0.02,
    "shN": 0.005,
    "exponents": 0.01,
}
_LAST = 0.06
#: Weights of squared colour errors, and of depth errors in pixels on the surface, beside absolute colour errors.
_SQUARED, _DEPTH = 200.0, 0.004
#: Of a view beside the training views: standard deviation of its place, median distances between neighbouring cameras,
#: and of its rotation, radians.
_SHIFT, _TURN = 0.3, 0.03
#: Training views, at most, that Gaussians are compared on; and how much larger their squared error may be: 0.2 dB.
_COMPARED, _MUCH = 8, 1.047
#: Memory for targets.
_TARGET_BYTES = 1 << 30
_WANTS = ("rgb", "alpha", "depth_accumulated")


#: A camera, and the training frame that it took, if any.
_View = tuple[Camera, Frame | None]


@dataclass(frozen=True)
class _Target:
    """Target image and depth of a view that Gaussians are fitted to, in the held light."""

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]  # accumulated, as the run renders it
    mask: Bool[Tensor, "H W"] | None
    error: Float[Tensor, ""]  # mean squared error of the run: 0 between training frames


def distil(
    field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None, seconds: float, steps: int | None = None
) -> int:
    """Fit explicit Gaussians, in place, to renderings of a run in a held light; returns the number of steps.

    Half of the views are training frames, brought to that light as the held-out ones are that a file is compared with:
    the run's render there, plus what the run's render as recorded misses of the frame. The others are what the run
    renders beside them: between neighbouring ones, moved and turned a little. It ends after so many seconds, or so many
    steps (:data:`STEPS`): without an end in time (``seconds`` infinite), a run gives the same Gaussians again.
    """
    steps = STEPS if steps is None else steps
    renderer = splatting_of(model_of_gaussians(field, trained))
    unit = trained.scene.pixel_footprint
    unit = unit if unit > 0 else 1.0  # without points it is NaN
    rates = {name: _RATES[name] * (unit if name == "means" else 1.0) for name in field.row_parameters}
    groups = [{"params": [getattr(field, name)], "name": name} for name in rates]
    adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
    chance = generators(trained.seed)["frame_order"]
    cameras = [adjusted_camera(trained, frame) for frame in trained.scene.train]
    frames: list[_View] = list(zip(cameras, trained.scene.train, strict=True))
    views = _some(frames) + _some([(camera, None) for camera in beside(cameras, chance)])
    targets: dict[int, _Target] = {}
    order: list[int] = []
    start, step = time.monotonic(), 0
    with ProgressReport("fit to what the run renders", steps) as progress:
        while (share := max(step / steps, (time.monotonic() - start) / max(seconds, 1e-9))) < 1.0:
            step += 1
            order = order or torch.randperm(len(views), generator=chance).tolist()
            index = order.pop()
            if index not in targets:
                targets[index] = _target(trained, *views[index], light)
            target = targets[index]
            output = renderer.draw(field.gaussians(target.camera), target.camera, _WANTS)
            errors = output.rgb - target.rgb
            colors = masked_mean(errors.abs() + _SQUARED * errors.square(), target.mask)
            depths = (output["depth_accumulated"] - target.depth).abs().mean() / unit
            loss = colors + _DEPTH * depths
            if not torch.isfinite(loss):
                raise NotFiniteError(f"baking, step {step}: the loss is {float(loss)}")
            adam.zero_grad(set_to_none=True)
            torch.autograd.backward(loss)
            for group in adam.param_groups:
                group["lr"] = log_linear(rates[group["name"]], _LAST * rates[group["name"]], share)
            adam.step()
            progress.update(max(step, int(share * steps)), f"loss {float(loss.detach()):.4f}")
    return step


def beside(cameras: Sequence[Camera], generator: torch.Generator) -> list[Camera]:
    """A random camera between each two neighbours of a path, moved and turned a little; one beside a single camera."""
    pairs = list(pairwise(cameras)) or [(cameras[0], cameras[0])]
    steps = sorted(float((a.center - b.center).norm()) for a, b in pairs)
    cameras_beside = []
    for pair in pairs:
        share = float(torch.rand((), generator=generator))
        turn, shift = (size * torch.randn(3, generator=generator) for size in (_TURN, _SHIFT * steps[len(steps) // 2]))
        moved = mean_camera(pair, (1.0 - share, share)).moved(turn, shift, 0.0)
        cameras_beside.append(replace(moved, camera_to_world=moved.camera_to_world.to(pair[0].camera_to_world)))
    return cameras_beside


def _some(views: list[_View]) -> list[_View]:
    """Evenly spaced views, so many that the targets of twice as many fit into memory."""
    count = max(1, _TARGET_BYTES // (32 * views[0][0].height * views[0][0].width))
    return views[:: -(-len(views) // count)]


def needs_distillation(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None) -> bool:
    """Tell whether Gaussians miss training frames in a light by more than the run does."""
    compared = _compared(field, trained, light, trained.scene.train[:: -(-len(trained.scene.train) // _COMPARED)])
    run_error, error, _ = compared.mean(0).tolist()
    return bool(error > _MUCH * run_error)


def best_frame(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None) -> int:
    """Index of the training frame, of some, that a view of Gaussians starts at.

    Of the half of the frames with the larger median depths, which look along the lumen and not at a wall close to the
    lens, it is the one that they show best.
    """
    every = -(-len(trained.scene.train) // (2 * _COMPARED))
    _, errors, depths = _compared(field, trained, light, trained.scene.train[::every]).unbind(1)
    return every * int(errors.where(depths >= depths.median(), math.inf).argmin())


@torch.no_grad()
def _compared(
    field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None, frames: Sequence[Frame]
) -> Float[Tensor, "F 3"]:
    """Mean squared errors of the run and of Gaussians on training frames brought to a light; median depths. [F, 3]"""
    renderer = splatting_of(model_of_gaussians(field, trained))
    rows = []
    for frame in frames:
        target = _target(trained, adjusted_camera(trained, frame), frame, light)
        shown = renderer.draw(field.gaussians(target.camera), target.camera, ("rgb", "alpha")).rgb
        error = masked_mean((shown - target.rgb).square(), target.mask)
        rows.append(torch.stack([target.error, error, target.depth.median()]))
    return torch.stack(rows)


@torch.no_grad()
def _target(trained: TrainedRun, camera: Camera, frame: Frame | None, light: HeldLight | None) -> _Target:
    output = render_held(trained.model, camera, light, _WANTS)
    rgb, depth = output.rgb, output["depth_accumulated"]
    if frame is None:
        return _Target(camera, rgb, depth, None, rgb.new_zeros(()))
    placed = frame.to(trained.device)
    missed = placed.rgb - render_view(trained, placed, ("rgb", "alpha")).rgb
    return _Target(camera, rgb + missed, depth, placed.mask, masked_mean(missed.square(), placed.mask))


def model_of_gaussians(field: ExplicitGaussians, trained: TrainedRun) -> Model:
    """A model of explicit Gaussians, with a renderer of the run's config for 3D Gaussians and no view modules."""
    renderer = choose_renderer(trained.config.renderer, "gaussians3d", trained.device).renderer
    near_plane = trained.model.near_plane / trained.model.scale
    return Model(field, renderer, {}, near_plane).to(trained.device).eval()


@torch.no_grad()
def adjusted_camera(trained: TrainedRun, frame: Frame) -> Camera:
    """Camera of a frame, scene units, as the run's view modules adjust it, float32 on the run's device."""
    view = frame.view(trained=frame.name in trained.training_frames)
    camera = trained.model.adjusted(frame.camera.to(trained.device), view)
    return camera.scaled(1.0 / trained.model.scale).to(dtype=torch.float32)
