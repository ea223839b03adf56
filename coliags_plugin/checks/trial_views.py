"""Trial of a renderer on a device: values, gradients and speed (``coliags doctor``)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.engine.costs import RenderMeter
from coliags_plugin.renderers.splatting import SplattingRenderer
from coliags_plugin.renderers.torch_renderer import TorchRenderer

#: Largest errors of outputs and gradients that pass, each relative to its own largest value.
OUTPUT_TOLERANCE, GRADIENT_TOLERANCE = 5e-5, 5e-4
INPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")
#: Thresholds so low that no pixel shows on which side of them rounding has put a Gaussian.
CUTS = {"alpha_min": 1e-6, "transmittance_min": 0.0}
#: Gaussians, width and height (pixels) of the views of both trials; some twenty are drawn at a pixel of either.
ACCURACY, SPEED = (200, 96, 64), (25_000, 320, 256)
#: Timed frames after the first.
FRAMES = 5


def try_renderer(renderer_class: type[SplattingRenderer], device: torch.device) -> str:
    """Largest errors and frames per second of a renderer with thresholds, in words.

    Errors are those in float32 on the device against the definition in float64 on the CPU, each relative to the largest
    value of the output or gradient; CheckFailedError where one is larger than its tolerance.
    """
    renderer, exact = _without_thresholds(renderer_class), _without_thresholds(TorchRenderer)
    told, wrong = [], []
    for primitive in sorted(renderer_class.primitives):
        wants = [name for name in OUTPUTS if name in renderer.outputs_of(primitive)]
        found = _values(renderer, primitive, wants, device, torch.float32)
        true = _values(exact, primitive, wants, torch.device("cpu"), torch.float64)
        errors = {name: float((found[name] - true[name]).abs().max() / true[name].abs().max()) for name in true}
        for name, error in errors.items():
            if not error <= (OUTPUT_TOLERANCE if name in wants else GRADIENT_TOLERANCE):  # NaN is wrong
                wrong.append(f"{name} of {primitive} by {error:.1e}")
        worst = max(errors.values())
        told.append(f"{primitive}: error at most {worst:.1e}, {_speed(renderer, primitive, device):.4g} frames/s")
    if wrong:
        raise CheckFailedError(f"wrong: {', '.join(wrong)}")
    return "; ".join(told)


def _without_thresholds(kind: Any) -> SplattingRenderer:
    return kind(kind.Settings(**CUTS))


def strewn(count: int, width: int, height: int, primitive: str) -> tuple[Gaussians, Camera]:
    """Gaussians at random before a camera, float32, on the CPU; the same each time."""
    camera = Camera(0.9 * width, 0.9 * width, 0.5 * width, 0.5 * height, width, height, torch.eye(4))
    generator = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=generator)

    z = uniform(20.0, 60.0)
    x, y = (uniform(0.0, width) - camera.cx) / camera.fx, (uniform(0.0, height) - camera.cy) / camera.fy
    pixels = (width * height / count) ** 0.5  # between neighbours in the image
    scales = uniform(0.3, 1.3, 3 if primitive == "gaussians3d" else 2) * (pixels * z / camera.fx)[:, None]
    # Not edge-on, where float32 does not tell where a ray meets a disc.
    quats = torch.cat([torch.ones(count, 1), uniform(-0.3, 0.3, 3)], dim=1)
    index = torch.arange(count)
    means = torch.stack([x * z, y * z, z], dim=1)
    return Gaussians(means, quats, scales, uniform(0.1, 0.9), uniform(0.0, 1.0, 3), index, index), camera


def _values(
    renderer: SplattingRenderer, primitive: str, wants: list[str], device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Outputs but the median depth, which jumps, and gradients of their sum with random weights; float64."""
    gaussians, camera = strewn(*ACCURACY, primitive)
    inputs = {name: getattr(gaussians, name).to(device, dtype, copy=True).requires_grad_() for name in INPUTS}
    pose = camera.camera_to_world.to(device, dtype, copy=True).requires_grad_()
    output = renderer.draw(replace(gaussians, **inputs), replace(camera, camera_to_world=pose), wants)
    maps, generator = {name: output[name] for name in wants if name != "depth_median"}, torch.Generator().manual_seed(1)
    weights = [torch.randn(values.shape, generator=generator).to(values) for values in maps.values()]
    torch.autograd.backward(list(maps.values()), weights)
    gradients = {name: torch.as_tensor(value.grad) for name, value in {**inputs, "pose": pose}.items()}
    return {name: value.detach().to("cpu", torch.float64) for name, value in (maps | gradients).items()}


@torch.no_grad()
def _speed(renderer: SplattingRenderer, primitive: str, device: torch.device) -> float | None:
    gaussians, camera = strewn(*SPEED, primitive)
    moved = {name: getattr(gaussians, name).to(device) for name in (*INPUTS, "source_index")}
    gaussians, camera = replace(gaussians, **moved), camera.to(device)
    meter = RenderMeter(device)
    for _ in range(FRAMES + 1):
        meter.render(lambda: renderer.draw(gaussians, camera, ("rgb", "alpha")))
    return meter.fps
