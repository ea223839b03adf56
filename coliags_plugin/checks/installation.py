"""``coliags check installation``: libraries, devices, weights, and renderers, which are tried."""

from __future__ import annotations

import importlib
import os
import platform
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
from torch import Tensor

from coliags_plugin.checks.results import CheckFailedError, CheckResult, CheckSkippedError, fail_if, run_check
from coliags_plugin.core import __version__, registry
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import is_auto, make_component
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.engine.costs import RenderMeter
from coliags_plugin.engine.devices import choose_device, find_device
from coliags_plugin.metrics.lpips import DEFAULT_NETS, WEIGHTS_VARIABLE, find_weights, searched_folders
from coliags_plugin.renderers.splatting import CutSettings, SplattingRenderer, choose_renderer
from coliags_plugin.renderers.torch_renderer import TorchRenderer

#: Distribution -> module. Imported for real: a library that is installed may still fail to load.
LIBRARIES = {
    "numpy": "numpy",
    "kornia": "kornia",
    "opencv-contrib-python-headless": "cv2",
    "av": "av",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "safetensors": "safetensors",
}

_NO_CUDA = (
    "no device: everything runs on the CPU. Where there is one, its renderers are tried here: errors against the "
    "definition, and frames per second; with `device=cpu`, those of the CPU"
)
_HINT = "Until that is mended, `renderer=torch` or `device=cpu` do without it"


def check_installation(device: str = "auto") -> list[CheckResult]:
    """Check what training and evaluation depend on; a missing optional part has status ``skipped``.

    Args:
        device: Device whose renderers are tried on views: ``cpu``, ``cuda`` or ``cuda:N``; ``auto``: the first CUDA
            device, or none without.

    Raises:
        InputError: There is no such device.
    """
    chosen = find_device(device)
    tried = choose_device(str(chosen)) if chosen.type == "cuda" or device == "cpu" else None
    threads = f"{torch.get_num_threads()} threads of {os.cpu_count()} CPUs"
    checks: dict[str, Callable[[], str]] = {
        "coliags_plugin": lambda: __version__,
        "python": lambda: f"{platform.python_version()} on {platform.machine()}",
        "torch": lambda: f"{torch.__version__}, {threads}",
        "cuda": _cuda,
        **{f"cuda:{index}": partial(_cuda_device, index) for index in range(torch.cuda.device_count())},
        **{name: partial(_library, name, module) for name, module in LIBRARIES.items()},
        **{f"renderer {name}": partial(_renderer, name, chosen, tried) for name in registry.renderers},
        **{f"weights of LPIPS {net}": partial(_lpips, net) for net in DEFAULT_NETS},
    }
    return [run_check(name, check) for name, check in checks.items()]


def _cuda() -> str:
    if not torch.cuda.is_available():
        raise CheckSkippedError(_NO_CUDA)
    built = f"CUDA {torch.version.cuda}" if torch.version.cuda else f"ROCm {torch.version.hip}"
    return f"PyTorch for {built}"


def _cuda_device(index: int) -> str:
    device = torch.cuda.get_device_properties(index)
    return f"{device.name}, compute capability {device.major}.{device.minor}, {device.total_memory / 2**30:.1f} GiB"


def _library(name: str, module: str) -> str:
    try:
        installed = version(name)
        importlib.import_module(module)
    except PackageNotFoundError:
        raise CheckFailedError("is not installed: pip install coliags_plugin") from None
    except (ImportError, OSError) as error:
        hint = "; apt-get install libusb-1.0-0" if "libusb" in str(error) else ""
        raise CheckFailedError(f"{installed} does not load: {error}{hint}") from None
    return installed


def _renderer(name: str, device: torch.device, tried: torch.device | None) -> str:
    """Availability of a renderer, and the result of its trial on a device; None: no trial."""
    component = make_component("renderers", name)
    if is_auto(component.kind, component.name):
        chosen = choose_renderer(component, "gaussians3d", device)
        return f"would use {chosen.name} ({chosen.reason})"
    available = component.target.availability()
    if not available.ok:
        raise CheckSkippedError(f"cannot run here: {available.reason}")
    can_run = f"can run here: {available.reason}"
    if tried is None or tried.type not in component.target.devices or not isinstance(component.settings, CutSettings):
        return can_run
    try:
        return f"{can_run}; {try_renderer(component.target, tried)}"
    except CheckFailedError as error:
        raise CheckFailedError(f"{error}. {_HINT}") from None
    except Exception as error:  # of a driver, a compiler or a kernel: the reason in every case
        first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
        reason = f"{type(error).__name__}: {first[:300]}".rstrip(" .:")
        raise CheckFailedError(f"{reason}. {_HINT}; the traceback is in `coliags check installation --json`") from error


def _lpips(net: str) -> str:
    """Files of the weights, which are no requirement: without them LPIPS is left out, and nothing else."""
    try:
        backbone, heads = find_weights(net)
    except UnavailableError as error:
        folders = ", ".join(map(str, searched_folders()))
        detail = f"{error}. Looked in {folders}; {WEIGHTS_VARIABLE} can name a folder that has them"
        raise CheckSkippedError(detail) from None
    return f"{backbone} and {heads}"


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
    results, wrong = [], []
    for primitive in sorted(renderer_class.primitives):
        wants = [name for name in OUTPUTS if name in renderer.outputs_of(primitive)]
        values = _values(renderer, primitive, wants, device, torch.float32)
        true = _values(exact, primitive, wants, torch.device("cpu"), torch.float64)
        errors = {name: float((values[name] - true[name]).abs().max() / true[name].abs().max()) for name in true}
        for name, error in errors.items():
            if not error <= (OUTPUT_TOLERANCE if name in wants else GRADIENT_TOLERANCE):  # NaN is wrong
                wrong.append(f"{name} of {primitive} by {error:.1e}")
        speed = _speed(renderer, primitive, device)
        results.append(f"{primitive}: error at most {max(errors.values()):.1e}, {speed:.4g} frames/s")
    fail_if(wrong, "wrong")
    return "; ".join(results)


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
