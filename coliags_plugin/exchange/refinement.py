"""Refinement of baked Gaussians on the training views."""

from __future__ import annotations

import torch

from coliags_plugin.contracts import log_linear
from coliags_plugin.core.errors import NotFiniteError
from coliags_plugin.core.lamps import HeldLight
from coliags_plugin.core.masked import masked_mean
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.randomness import generators
from coliags_plugin.engine.rendering import render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.exchange.cameras import adjusted_camera
from coliags_plugin.exchange.held_light import render_held, splatting_of
from coliags_plugin.fields.explicit_gaussians import ExplicitGaussians

#: Steps, one training view each.
STEPS = 300
#: Adam's rates by parameter group at the first step; centres' in pixels on the surface. At the last step they are
#: _LAST of that.
_RATES = {"means": 0.005, "scales": 0.005, "quats": 0.001, "opacities": 0.02, "sh0": 0.0025, "shN": 0.00025}
_LAST = 0.03
#: Weights of squared colour errors, and of depth errors in pixels on the surface, beside absolute colour errors.
_SQUARED, _DEPTH = 20.0, 0.004
_WANTS = ("rgb", "alpha", "depth_accumulated")


def refine(field: ExplicitGaussians, trained: TrainedRun, light: HeldLight) -> int:
    """Fit baked Gaussians to the training frames in the held light, and to the depth that the run renders of them.

    Frames are brought to that light as the held-out ones are that a file is compared with: the run's render there, plus
    what the run's render as recorded misses of the frame.

    Args:
        field: Changed in place.
        trained: The run that it was baked from.
        light: What lights it.

    Returns:
        Steps taken.

    Raises:
        NotFiniteError: The loss became NaN or infinite.
    """
    renderer, frames = splatting_of(trained.model), trained.scene.train
    footprint = trained.scene.pixel_footprint
    unit = footprint if footprint > 0 else 1.0  # without points it is NaN
    rates = {**_RATES, "means": _RATES["means"] * unit}
    groups = {name: getattr(field, name) for name in rates}
    adam = torch.optim.Adam(
        [{"params": [group], "name": name} for name, group in groups.items()], eps=1e-15, fused=True
    )
    order: list[int] = []
    chance = generators(trained.seed)["frame_order"]
    with ProgressReport("bake: refine", STEPS) as progress:
        for step in range(1, STEPS + 1):
            order = order or torch.randperm(len(frames), generator=chance).tolist()
            frame = frames[order.pop()].to(trained.device)
            camera = adjusted_camera(trained, frame)
            with torch.no_grad():
                held = render_held(trained.model, camera, light, _WANTS)
                target = held.rgb + (frame.rgb - render_view(trained, frame, ("rgb", "alpha")).rgb)
            output = renderer.draw(field.gaussians(camera), camera, _WANTS)
            errors = output.rgb - target
            colors = masked_mean(errors.abs() + _SQUARED * errors.square(), frame.mask)
            depths = (output["depth_accumulated"] - held["depth_accumulated"]).abs().mean() / unit
            loss = colors + _DEPTH * depths
            if not torch.isfinite(loss):
                raise NotFiniteError(f"baking, step {step}, frame {frame.name}: the loss is {float(loss)}")
            adam.zero_grad(set_to_none=True)
            torch.autograd.backward(loss)
            for group in adam.param_groups:
                group["lr"] = log_linear(rates[group["name"]], _LAST * rates[group["name"]], step / STEPS)
            adam.step()
            progress.update(step, f"{-10.0 * float(errors.detach().square().mean().log10()):.2f} dB")
    return STEPS
