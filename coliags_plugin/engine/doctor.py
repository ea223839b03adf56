"""Diagnosis of an installation: libraries, devices, renderers, weights."""

from __future__ import annotations

import importlib
import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import torch

from coliags_plugin._version import __version__
from coliags_plugin.config import registry
from coliags_plugin.config.components import make_component
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


@dataclass(frozen=True)
class Finding:
    """One line of the diagnosis."""

    subject: str
    text: str
    ok: bool = True


def examine() -> list[Finding]:
    """Check everything that training and evaluation depend on."""
    cuda = torch.cuda.is_available()
    findings = [
        Finding("coliags_plugin", __version__),
        Finding("python", f"{platform.python_version()} on {platform.machine()}"),
        Finding("torch", f"{torch.__version__}, {torch.get_num_threads()} threads of {os.cpu_count()} CPUs"),
        Finding("cuda", torch.cuda.get_device_name(0) if cuda else "no device: everything runs on the CPU"),
    ]
    findings += [_library(name, module) for name, module in LIBRARIES.items()]
    findings += [_renderer(name) for name in registry.renderers]
    findings += [_lpips(net) for net in DEFAULT_NETS]
    return findings


def _library(name: str, module: str) -> Finding:
    try:
        found = version(name)
        importlib.import_module(module)
    except PackageNotFoundError:
        return Finding(name, "is not installed: pip install coliags_plugin", ok=False)
    except (ImportError, OSError) as error:
        hint = "; apt-get install libusb-1.0-0" if "libusb" in str(error) else ""
        return Finding(name, f"{found} does not load: {error}{hint}", ok=False)
    return Finding(name, found)


def _renderer(name: str) -> Finding:
    component = make_component("renderers", name)
    if component.target.alternatives(component.settings):
        try:
            chosen = choose_renderer(component, "gaussians3d", choose_device("auto"))
        except InputError as error:
            return Finding(f"renderer {name}", str(error), ok=False)
        return Finding(f"renderer {name}", f"would use {chosen.name} ({chosen.reason})")
    available = component.target.availability()
    return Finding(f"renderer {name}", f"{'can' if available.ok else 'cannot'} run here: {available.reason}")


def _lpips(net: str) -> Finding:
    """Weights are no requirement: without them LPIPS is left out, and nothing else."""
    try:
        backbone, heads = find_weights(net)
    except UnavailableError as error:
        folders = ", ".join(map(str, searched_folders()))
        told = f"{error}. Looked in {folders}; {WEIGHTS_VARIABLE} can name a folder that has them"
        return Finding(f"weights of LPIPS {net}", told)
    return Finding(f"weights of LPIPS {net}", f"{backbone} and {heads}")
