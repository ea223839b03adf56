"""Held-out views from poses refined on their own images, which tells errors of poses from those of the model."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.render_output import OPAQUE_ALPHA
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.datamanagers.shots import fitted
from coliags_plugin.engine.model import Model

#: Adam steps on each view; the first and last of their lengths, in pixels of the image that is rendered in them.
STEPS, FIRST_STEP, LAST_STEP = 40, 0.5, 0.05
#: Size that this image is within, pixels.
_WITHIN = (192, 192)


def refined_camera(model: Model, frame: Frame) -> Camera:
    """The camera of a held-out frame at the pose that fits its image best, found by gradients through a frozen model.

    Adam on the mean absolute difference over the valid pixels of a reduced image, from the frame's pose, after each
    colour was multiplied by its best factor, so that a wrong exposure moves no pose; view modules act as they do on the
    frame. The camera turns about the median rendered depth on its axis. The pose of least difference along the way is
    returned; that given where nothing opaque is in view.

    Args:
        model: On the frame's device.
        frame: Held out.
    """
    camera, view = _reduced(frame.camera), frame.view(trained=False)
    image, valid = _area_mean(frame.rgb, camera), _area_mean(frame.valid[..., None].float(), camera)[..., 0] == 1.0
    with torch.no_grad():
        output = model.render(camera, ("rgb", "alpha", "depth_expected"), view)
    opaque = output.alpha >= OPAQUE_ALPHA
    if not opaque.any():
        return frame.camera
    depth = float(output["depth_expected"][opaque].median())
    pixel = 1.0 / (camera.fx * camera.fy) ** 0.5  # radians, and in depths
    motion = torch.zeros(6, device=image.device, requires_grad=True)  # rotation and translation, pixels
    optimizer = torch.optim.Adam([motion], lr=FIRST_STEP)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (LAST_STEP / FIRST_STEP) ** (1.0 / STEPS))
    least, best = torch.inf, motion.detach()
    with _frozen(model):
        for _ in range(STEPS):
            turn, shift = pixel * motion[:3], pixel * depth * motion[3:]
            rgb = model.render(camera.moved(turn, shift, depth), ("rgb", "alpha"), view).rgb
            error = masked_mean((rgb * color_factors(rgb, image, valid) - image).abs(), valid)
            if error.item() < least:
                least, best = error.item(), motion.detach().clone()
            optimizer.zero_grad()
            torch.autograd.backward(error)
            optimizer.step()
            decay.step()
    return frame.camera.moved(pixel * best[:3], pixel * depth * best[3:], depth)


@contextmanager
def _frozen(model: nn.Module) -> Iterator[None]:
    """Without gradients of the parameters."""
    learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learned:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)


def _reduced(camera: Camera) -> Camera:
    return camera.resized(*fitted(camera.width, camera.height, _WITHIN))


def _area_mean(values: Float[Tensor, "H W C"], camera: Camera) -> Float[Tensor, "h w C"]:
    """An image at the size of a camera."""
    small = functional.interpolate(values.permute(2, 0, 1)[None], (camera.height, camera.width), mode="area")
    return small[0].permute(1, 2, 0)


@torch.no_grad()
def color_factors(
    rgb: Float[Tensor, "H W 3"], true: Float[Tensor, "H W 3"], valid: Bool[Tensor, "H W"]
) -> Float[Tensor, "3"]:
    """The factor on each colour of least squared difference over the valid pixels."""
    rendered = rgb[valid]
    return (rendered * true[valid]).sum(0) / rendered.square().sum(0).clamp_min(1e-12)
