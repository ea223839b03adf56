"""Check of an installation: libraries, devices, renderers, weights (``coliags doctor``)."""

from __future__ import annotations

import importlib
import os
import platform
from importlib.metadata import PackageNotFoundError, version

import torch

from coliags_plugin._version import __version__
from coliags_plugin.checks.results import CheckResult
from coliags_plugin.config import registry
from coliags_plugin.config.components import is_auto, make_component
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.metrics.lpips_weights import DEFAULT_NETS, WEIGHTS_VARIABLE, find_weights, searched_folders
from coliags_plugin.renderers.choice import choose_renderer

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


def check_installation() -> list[CheckResult]:
    """Check what training and evaluation depend on; a missing optional part has status ``skipped``."""
    threads = f"{torch.get_num_threads()} threads of {os.cpu_count()} CPUs"
    results = [
        CheckResult("coliags_plugin", "passed", __version__),
        CheckResult("python", "passed", f"{platform.python_version()} on {platform.machine()}"),
        CheckResult("torch", "passed", f"{torch.__version__}, {threads}"),
        _cuda(),
    ]
    results += [_library(name, module) for name, module in LIBRARIES.items()]
    results += [_renderer(name) for name in registry.renderers]
    results += [_lpips(net) for net in DEFAULT_NETS]
    return results


def _cuda() -> CheckResult:
    if torch.cuda.is_available():
        return CheckResult("cuda", "passed", torch.cuda.get_device_name(0))
    return CheckResult("cuda", "skipped", "no device: everything runs on the CPU")


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


def _renderer(name: str) -> CheckResult:
    component, title = make_component("renderers", name), f"renderer {name}"
    if is_auto(component.kind, component.name):
        try:
            chosen = choose_renderer(component, "gaussians3d", choose_device("auto"))
        except InputError as error:
            return CheckResult(title, "failed", str(error))
        return CheckResult(title, "passed", f"would use {chosen.name} ({chosen.reason})")
    available = component.target.availability()
    if available.ok:
        return CheckResult(title, "passed", f"can run here: {available.reason}")
    return CheckResult(title, "skipped", f"cannot run here: {available.reason}")


def _lpips(net: str) -> CheckResult:
    """Weights are no requirement: without them LPIPS is left out, and nothing else."""
    try:
        backbone, heads = find_weights(net)
    except UnavailableError as error:
        folders = ", ".join(map(str, searched_folders()))
        detail = f"{error}. Looked in {folders}; {WEIGHTS_VARIABLE} can name a folder that has them"
        return CheckResult(f"weights of LPIPS {net}", "skipped", detail)
    return CheckResult(f"weights of LPIPS {net}", "passed", f"{backbone} and {heads}")
