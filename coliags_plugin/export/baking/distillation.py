"""Distillation of a run into explicit Gaussians: a fit to its renderings along and around the camera path."""

from __future__ import annotations

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
from coliags_plugin.core.masked import masked_mean
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import mean_camera, render_held, splatting_of
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.randomness import generators
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians
from coliags_plugin.lighting.lamps import HeldLight
from coliags_plugin.renderers.choice import choose_renderer

#: Steps, one view each, that are taken where the time allows.
STEPS = 3000
#: Adam's rates by parameter group at the first step; centres' in pixels on the surface. At the last step they are
#: _LAST of that.
_RATES = {"means": 0.2, "scales": 0.08, "quats": 0.04, "opacities": 0.15, "sh0": 0.04, "shN": 0.00075}
_LAST = 0.06
#: Weights of squared colour errors, and of depth errors in pixels on the surface, beside absolute colour errors.
_SQUARED, _DEPTH = 200.0, 0.004
#: Share of the steps on views beside the training views.
_BESIDE = 0.2
#: Of such a view: standard deviation of its place, median distances between neighbouring cameras, and of its rotation,
#: radians.
_SHIFT, _TURN = 0.3, 0.03
#: Training views, at most, that Gaussians are compared on; and how much larger their squared error may be: 0.2 dB.
_COMPARED, _MUCH = 8, 1.047
#: How much larger this error may be, as a multiple of the run's, where a view starts than where it is least: 1 dB.
_NEARLY = 1.26
#: Memory for targets.
_TARGET_BYTES = 1 << 30
_WANTS = ("rgb", "alpha", "depth_accumulated")


@dataclass(frozen=True)
class _Target:
    """A view in the held light."""

    camera: Camera
    rgb: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]  # accumulated depth that the run renders
    mask: Bool[Tensor, "H W"] | None = None


def distil(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None, seconds: float) -> int:
    """Fit explicit Gaussians, in place, to renderings of a run in a held light; returns the number of steps.

    Most of the views are training frames, brought to that light as the held-out ones are that a file is compared with:
    the run's render there, plus what the run's render as recorded misses of the frame. The others are what the run
    renders beside them, from as many cameras: between neighbouring ones, moved and turned a little. It ends after so
    many seconds, or :data:`STEPS`.
    """
    renderer = splatting_of(model_of_gaussians(field, trained))
    unit = trained.scene.pixel_footprint
    unit = unit if unit > 0 else 1.0  # without points it is NaN
    rates = {**_RATES, "means": _RATES["means"] * unit}
    groups = [{"params": [getattr(field, name)], "name": name} for name in rates]
    adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
    frames = _some_frames(trained.scene.train)
    chance = generators(trained.seed)["frame_order"]
    cameras = [adjusted_camera(trained, frame) for frame in trained.scene.train]
    nearby = [beside(cameras, chance) for _ in frames]
    targets: dict[int, _Target] = {}  # of frames, then of cameras beside them
    order: list[int] = []
    start, step = time.monotonic(), 0
    with ProgressReport("fit to what the run renders", STEPS) as progress:
        while (done := max(step / STEPS, (time.monotonic() - start) / max(seconds, 1e-9))) < 1.0:
            step += 1
            if float(torch.rand((), generator=chance)) < _BESIDE:
                index = len(frames) + int(torch.randint(len(nearby), (), generator=chance))
            else:
                order = order or torch.randperm(len(frames), generator=chance).tolist()
                index = order.pop()
            if index not in targets:
                if index < len(frames):
                    targets[index] = _target(trained, frames[index], light)
                else:
                    camera = nearby[index - len(frames)]
                    targets[index] = _Target(camera, *_held(trained, camera, light))
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
                group["lr"] = log_linear(rates[group["name"]], _LAST * rates[group["name"]], done)
            adam.step()
            progress.update(max(step, int(done * STEPS)), f"loss {float(loss.detach()):.4f}")
    return step


def beside(cameras: Sequence[Camera], generator: torch.Generator) -> Camera:
    """A random camera between two neighbours of a path, moved and turned a little; of a single camera, beside it."""
    index = int(torch.randint(max(1, len(cameras) - 1), (), generator=generator))
    pair = cameras[index : index + 2]
    share = float(torch.rand((), generator=generator))
    steps = [float((a.center - b.center).norm()) for a, b in pairwise(cameras)]
    length = sorted(steps)[len(steps) // 2] if steps else 0.0
    between = mean_camera(pair, (1.0 - share, share)[: len(pair)])
    turn, shift = (size * torch.randn(3, generator=generator) for size in (_TURN, _SHIFT * length))
    like = cameras[0].camera_to_world
    moved = between.moved(turn, shift, 0.0)
    return replace(moved, camera_to_world=moved.camera_to_world.to(like))


def _some_frames(frames: list[Frame]) -> list[Frame]:
    """Evenly spaced frames, so many that their targets, and as many beside them, fit into memory."""
    height, width = frames[0].camera.height, frames[0].camera.width
    count = max(1, _TARGET_BYTES // (32 * height * width))
    return frames[:: -(-len(frames) // count)]


def needs_distillation(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None) -> bool:
    """Whether Gaussians miss training frames in a light by more than the run does."""
    compared = _compared(field, trained, light, trained.scene.train[:: -(-len(trained.scene.train) // _COMPARED)])
    own, baked, _ = compared.mean(0).tolist()
    return bool(baked > _MUCH * own)


def best_frame(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None) -> int:
    """Index of the training frame, of some, that a view of Gaussians starts at.

    Of the frames that they show nearly as well as the best one in comparison with the run, it is the one with the
    largest median depth: not of a wall close to the lens, but along the lumen.
    """
    every = -(-len(trained.scene.train) // (2 * _COMPARED))
    own, baked, depths = _compared(field, trained, light, trained.scene.train[::every]).unbind(1)
    losses = baked / own.clamp_min(1e-12)
    return every * int(depths.where(losses <= _NEARLY * losses.min(), -1.0).argmax())


@torch.no_grad()
def _compared(
    field: ExplicitGaussians, trained: TrainedRun, light: HeldLight | None, frames: Sequence[Frame]
) -> Float[Tensor, "F 3"]:
    """Mean squared errors of the run and of Gaussians on training frames brought to a light; median depths. [F, 3]"""
    renderer = splatting_of(model_of_gaussians(field, trained))
    rows = []
    for frame in frames:
        target = _target(trained, frame, light)
        held, _ = _held(trained, target.camera, light)
        shown = renderer.draw(field.gaussians(target.camera), target.camera, ("rgb", "alpha")).rgb
        errors = [masked_mean((rgb - target.rgb).square(), target.mask) for rgb in (held, shown)]
        rows.append(torch.stack([*errors, target.depth.median()]))
    return torch.stack(rows)


@torch.no_grad()
def _target(trained: TrainedRun, frame: Frame, light: HeldLight | None) -> _Target:
    placed = frame.to(trained.device)
    camera = adjusted_camera(trained, frame)
    rgb, depth = _held(trained, camera, light)
    missed = placed.rgb - render_view(trained, placed, ("rgb", "alpha")).rgb
    return _Target(camera, rgb + missed, depth, placed.mask)


@torch.no_grad()
def _held(
    trained: TrainedRun, camera: Camera, light: HeldLight | None
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Colours and accumulated depth that a run renders in the held light."""
    output = render_held(trained.model, camera, light, _WANTS)
    return output.rgb, output["depth_accumulated"]


def model_of_gaussians(field: ExplicitGaussians, trained: TrainedRun) -> Model:
    """A model of explicit Gaussians, with a renderer of the run's config for 3D Gaussians and no view modules."""
    renderer = choose_renderer(trained.config.renderer, "gaussians3d", trained.device).renderer
    near_plane = trained.model.near_plane / trained.model.scale
    return Model(field, renderer, {}, near_plane).to(trained.device).eval()


@torch.no_grad()
def adjusted_camera(trained: TrainedRun, frame: Frame) -> Camera:
    """Camera of a frame, scene units, as the run's view modules adjust it, float32 on the run's device."""
    camera = trained.model.placed(frame.camera.to(trained.device))
    view = frame.view(trained=frame.name in trained.training_frames)
    for module in trained.model.view_modules.values():
        camera = module.adjust_camera(camera, view)
    return camera.scaled(1.0 / trained.model.scale).to(dtype=torch.float32)
