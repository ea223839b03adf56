"""Check of an installation: libraries, devices, renderers, weights (``coliags doctor``)."""

from __future__ import annotations

import ctypes
import importlib
import os
import platform
import traceback
from importlib.metadata import PackageNotFoundError, version

import torch

from coliags_plugin._version import __version__
from coliags_plugin.checks.results import CheckFailedError, CheckResult
from coliags_plugin.checks.trial_views import try_renderer
from coliags_plugin.config import registry
from coliags_plugin.config.components import is_auto, make_component
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.engine.devices import choose_device, find_device
from coliags_plugin.metrics.lpips_weights import DEFAULT_NETS, WEIGHTS_VARIABLE, find_weights, searched_folders
from coliags_plugin.renderers.choice import choose_renderer
from coliags_plugin.renderers.splatting import CutSettings

#: Distribution -> module. Imported for real: a library that is installed may still fail to load.
LIBRARIES = {
    "numpy": "numpy",
    "kornia": "kornia",
    "opencv-contrib-python-headless": "cv2",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "safetensors": "safetensors",
}

_NO_CUDA = (
    "no device: everything runs on the CPU. Where there is one, its renderers are tried here: errors against the "
    "definition, and frames per second; with --device cpu, those of the CPU"
)
_HINT = "Until that is mended, --set renderer=torch or --device cpu do without it"


def check_installation(device: str = "auto") -> list[CheckResult]:
    """Check what training and evaluation depend on; a missing optional part has status ``skipped``.

    Args:
        device: Whose renderers are tried on views: ``cpu``, ``cuda`` or ``cuda:N``; ``auto``: of the first CUDA device,
            or none without.

    Raises:
        InputError: There is no such device.
    """
    chosen = find_device(device)
    threads = f"{torch.get_num_threads()} threads of {os.cpu_count()} CPUs"
    results = [
        CheckResult("coliags_plugin", "passed", __version__),
        CheckResult("python", "passed", f"{platform.python_version()} on {platform.machine()}"),
        CheckResult("torch", "passed", f"{torch.__version__}, {threads}"),
        *_cuda(),
    ]
    results += [_library(name, module) for name, module in LIBRARIES.items()]
    tried = choose_device(str(chosen)) if chosen.type == "cuda" or device == "cpu" else None
    results += [_renderer(name, chosen, tried) for name in registry.renderers]
    results += [_lpips(net) for net in DEFAULT_NETS]
    return results


def _cuda() -> list[CheckResult]:
    """Versions, and a line for each device."""
    if not torch.cuda.is_available():
        return [CheckResult("cuda", "skipped", _NO_CUDA)]
    built = f"CUDA {torch.version.cuda}" if torch.version.cuda else f"ROCm {torch.version.hip}"
    versions = f"PyTorch for {built}; the driver serves CUDA {_driver_version() or 'of unknown version'}"
    results = [CheckResult("cuda", "passed", versions)]
    for index in range(torch.cuda.device_count()):
        found = torch.cuda.get_device_properties(index)
        told = f"{found.name}, compute capability {found.major}.{found.minor}, {found.total_memory / 2**30:.1f} GiB"
        results.append(CheckResult(f"cuda:{index}", "passed", told))
    return results


def _driver_version() -> str | None:
    """The newest CUDA version that the installed driver supports; None where it does not tell."""
    number = ctypes.c_int()
    try:
        status = ctypes.CDLL("libcuda.so.1").cuDriverGetVersion(ctypes.byref(number))
    except (OSError, AttributeError):  # on Windows, or none is installed
        return None
    return None if status else f"{number.value // 1000}.{number.value % 1000 // 10}"


def _library(name: str, module: str) -> CheckResult:
    try:
        installed = version(name)
        importlib.import_module(module)
    except PackageNotFoundError:
        return CheckResult(name, "failed", "is not installed: pip install coliags_plugin")
    except (ImportError, OSError) as error:
        hint = "; apt-get install libusb-1.0-0" if "libusb" in str(error) else ""
        return CheckResult(name, "failed", f"{installed} does not load: {error}{hint}")
    return CheckResult(name, "passed", installed)


def _renderer(name: str, device: torch.device, tried: torch.device | None) -> CheckResult:
    """Whether a renderer can run here, and what its trial on a device came to; None: no trial."""
    component, title = make_component("renderers", name), f"renderer {name}"
    if is_auto(component.kind, component.name):
        chosen = choose_renderer(component, "gaussians3d", device)
        return CheckResult(title, "passed", f"would use {chosen.name} ({chosen.reason})")
    available = component.target.availability()
    if not available.ok:
        return CheckResult(title, "skipped", f"cannot run here: {available.reason}")
    can_run = f"can run here: {available.reason}"
    if tried is None or tried.type not in component.target.devices or not isinstance(component.settings, CutSettings):
        return CheckResult(title, "passed", can_run)
    try:
        return CheckResult(title, "passed", f"{can_run}; {try_renderer(component.target, tried)}")
    except CheckFailedError as error:
        return CheckResult(title, "failed", f"{error}. {_HINT}")
    except Exception as error:  # of a driver, a compiler or a kernel: the reason in every case
        first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
        told = f"{type(error).__name__}: {first[:300]}".rstrip(" .:")
        detail = f"{told}. {_HINT}; the traceback is in doctor --json"
        return CheckResult(title, "failed", detail, traceback=traceback.format_exc())


def _lpips(net: str) -> CheckResult:
    """Weights are no requirement: without them LPIPS is left out, and nothing else."""
    try:
        backbone, heads = find_weights(net)
    except UnavailableError as error:
        folders = ", ".join(map(str, searched_folders()))
        detail = f"{error}. Looked in {folders}; {WEIGHTS_VARIABLE} can name a folder that has them"
        return CheckResult(f"weights of LPIPS {net}", "skipped", detail)
    return CheckResult(f"weights of LPIPS {net}", "passed", f"{backbone} and {heads}")
