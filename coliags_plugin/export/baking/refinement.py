"""Refinement of baked Gaussians on the training views."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.contracts import log_linear
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import NotFiniteError
from coliags_plugin.core.masked import masked_mean
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import render_held, splatting_of
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.randomness import generators
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians
from coliags_plugin.lighting.lamps import HeldLight

#: Steps, one training view each.
STEPS = 300
#: Adam's rates by parameter group at the first step; centres' in pixels on the surface. At the last step they are
#: _LAST of that.
_RATES = {"means": 0.005, "scales": 0.005, "quats": 0.001, "opacities": 0.02, "sh0": 0.0025, "shN": 0.00025}
_LAST = 0.03
#: Weights of squared colour errors, and of depth errors in pixels on the surface, beside absolute colour errors.
_SQUARED, _DEPTH = 20.0, 0.004
#: Training views, at most, that averages are compared on; and how much larger their squared error may be: 0.2 dB.
_COMPARED, _MUCH = 8, 1.047
#: Memory for targets.
_TARGET_BYTES = 1 << 30
_WANTS = ("rgb", "alpha", "depth_accumulated")


@dataclass(frozen=True)
class _Target:
    """A training view in the held light."""

    camera: Camera  # of the frame, as the run's view modules adjust it
    rgb: Float[Tensor, "H W 3"]  # the frame, brought to the light
    depth: Float[Tensor, "H W"]  # accumulated depth that the run renders
    mask: Bool[Tensor, "H W"] | None  # of the frame


def refine(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight) -> int:
    """Fit baked Gaussians, in place, to training frames in the held light, and to the depth that the run renders there.

    Frames are brought to that light as the held-out ones are that a file is compared with: the run's render there, plus
    what the run's render as recorded misses of the frame. Returns the steps taken.
    """
    renderer = splatting_of(trained.model)
    unit = trained.scene.pixel_footprint
    unit = unit if unit > 0 else 1.0  # without points it is NaN
    rates = {**_RATES, "means": _RATES["means"] * unit}
    groups = [{"params": [getattr(field, name)], "name": name} for name in rates]
    adam = torch.optim.Adam(groups, eps=1e-15, fused=True)
    frames = _some_frames(trained.scene.train)
    targets: dict[int, _Target] = {}
    order: list[int] = []
    chance = generators(trained.seed)["frame_order"]
    with ProgressReport("bake: refine", STEPS) as progress:
        for step in range(1, STEPS + 1):
            order = order or torch.randperm(len(frames), generator=chance).tolist()
            index = order.pop()
            if index not in targets:
                targets[index] = _target(trained, frames[index], light)
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
                group["lr"] = log_linear(rates[group["name"]], _LAST * rates[group["name"]], step / STEPS)
            adam.step()
            progress.update(step, f"loss {float(loss.detach()):.4f}")
    return STEPS


def _some_frames(frames: list[Frame]) -> list[Frame]:
    """Evenly spaced frames, so many that their targets fit into memory."""
    height, width = frames[0].camera.height, frames[0].camera.width
    count = max(1, min(STEPS, _TARGET_BYTES // (16 * height * width)))
    return frames[:: -(-len(frames) // count)]


@torch.no_grad()
def needs_refinement(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight) -> bool:
    """Whether baked Gaussians miss training frames in the held light by more than the run does."""
    renderer, frames = splatting_of(trained.model), trained.scene.train
    own, baked = [], []
    for frame in frames[:: -(-len(frames) // _COMPARED)]:
        target = _target(trained, frame, light)
        held = render_held(trained.model, target.camera, light, ("rgb", "alpha")).rgb
        shown = renderer.draw(field.gaussians(target.camera), target.camera, ("rgb", "alpha")).rgb
        own.append(masked_mean((held - target.rgb).square(), target.mask))
        baked.append(masked_mean((shown - target.rgb).square(), target.mask))
    return float(torch.stack(baked).mean()) > _MUCH * float(torch.stack(own).mean())


@torch.no_grad()
def _target(trained: TrainedRun, frame: Frame, light: HeldLight) -> _Target:
    placed = frame.to(trained.device)
    camera = adjusted_camera(trained, frame)
    held = render_held(trained.model, camera, light, _WANTS)
    missed = placed.rgb - render_view(trained, placed, ("rgb", "alpha")).rgb
    return _Target(camera, held.rgb + missed, held["depth_accumulated"], placed.mask)


def adjusted_camera(trained: TrainedRun, frame: Frame) -> Camera:
    """Camera of a training frame, as the run's view modules adjust it, float32 on the run's device."""
    camera = frame.camera.to(trained.device)
    for module in trained.model.view_modules.values():
        camera = module.adjust_camera(camera, frame.view(trained=True))
    return camera.to(dtype=torch.float32)
