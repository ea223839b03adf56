"""Looking at the machine: libraries, devices, renderers, weights."""

from __future__ import annotations

import importlib
import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import torch

from coliags_plugin import __version__
from coliags_plugin.config import registry
from coliags_plugin.config.components import make_component
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.backends import choose_device, choose_renderer

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
    """One thing looked at."""

    subject: str
    text: str
    ok: bool = True


def examine() -> list[Finding]:
    """Everything that decides whether, where and with what this machine can train."""
    cuda = torch.cuda.is_available()
    findings = [
        Finding("coliags_plugin", __version__),
        Finding("python", f"{platform.python_version()} on {platform.machine()}"),
        Finding("torch", f"{torch.__version__}, {torch.get_num_threads()} threads of {os.cpu_count()} CPUs"),
        Finding("cuda", torch.cuda.get_device_name(0) if cuda else "no device: everything runs on the CPU"),
    ]
    findings += [_library(name, module) for name, module in LIBRARIES.items()]
    for name in registry.renderers:
        if name != "auto":
            available = registry.renderers.get(name).availability()
            text = f"{'can' if available.ok else 'cannot'} run here: {available.reason}"
            findings.append(Finding(f"renderer {name}", text))
    findings.append(_choice())
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


def _choice() -> Finding:
    try:
        chosen = choose_renderer(make_component("renderers", "auto"), "gaussians3d", choose_device("auto"))
    except InputError as error:
        return Finding("renderer auto", str(error), ok=False)
    return Finding("renderer auto", f"would use {chosen.name} ({chosen.reason})")
