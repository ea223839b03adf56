"""Lazy import of gsplat, with one test of its kernels per process.

gsplat compiles its kernels when they are first called. Without a CUDA device or a compiler it continues without them
and fails later with an attribute error on None; so it is imported only here, and only where PyTorch has a device.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import logging
import re
import sys
from types import ModuleType

import torch

from coliags_plugin.contracts import Availability
from coliags_plugin.core.errors import InputError

logger = logging.getLogger(__name__)

#: The first version whose radii come per axis, [..., 2].
OLDEST = (1, 5)
INSTALL = "pip install coliags_plugin[cuda]"
#: Device of the test.
PROBE_DEVICE = "cuda"


def availability() -> Availability:
    """Whether gsplat can be used here. The first call on a machine with a CUDA device may compile it for minutes."""
    if not torch.cuda.is_available():
        why = "" if torch.version.cuda else ", as this PyTorch is built without CUDA"
        return Availability(False, f"no CUDA device{why}")
    if importlib.util.find_spec("gsplat") is None:
        return Availability(False, f"gsplat is not installed: {INSTALL}")
    return _trial()


@functools.cache
def load() -> ModuleType:
    """Import gsplat after testing that it works; InputError with the reason where it does not."""
    found = availability()
    if not found.ok:
        raise InputError(
            f"renderer 'gsplat' cannot run here: {found.reason}",
            f"a CUDA device and gsplat {'.'.join(map(str, OLDEST))} or newer",
            "Choose renderer 'auto'",
        )
    return importlib.import_module("gsplat")


@functools.cache
def _trial() -> Availability:
    """Import the installed gsplat and test it on the device."""
    logger.info("loading gsplat; the first time on a machine it compiles its CUDA kernels, which takes minutes")
    try:
        library = importlib.import_module("gsplat")
    except Exception as error:  # any failure is the reason
        return Availability(False, f"gsplat does not load: {_one_line(error)}")
    named = f"gsplat {getattr(library, '__version__', 'of unknown version')}"
    if _release(named) < OLDEST:
        return Availability(False, f"{named} is too old, {'.'.join(map(str, OLDEST))} is needed: {INSTALL}")
    try:
        _project_one(library)
    except Exception as error:  # a compiler's, a driver's or a kernel's: the reason in every case
        backend = sys.modules.get("gsplat.cuda._backend")
        if backend is not None and getattr(backend, "_C", None) is None:
            return Availability(False, f"{named} has no CUDA kernels, and found no CUDA toolkit (nvcc) to build them")
        return Availability(False, f"{named} does not work on this device: {_one_line(error)}")
    return Availability(True, f"{named} on {torch.cuda.get_device_name()}")


def _project_one(library: ModuleType) -> None:
    """Check that a Gaussian on the optical axis projects to the principal point."""
    like = torch.eye(4, device=PROBE_DEVICE)
    intrinsics = torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]], device=PROBE_DEVICE)
    mean, quat, scale = like[None, 2, :3], like[None, 0], like.new_full((1, 3), 0.1)
    projected = library.fully_fused_projection(mean, None, quat, scale, like[None], intrinsics[None], 8, 8)
    radii, center = projected[0], projected[1].flatten().tolist()
    if tuple(radii.shape) != (1, 1, 2) or max(abs(value - 4.0) for value in center) > 1e-3:
        raise RuntimeError(f"a Gaussian that belongs at pixel (4, 4) is put at {center}, radii {radii.tolist()}")


def _release(text: str) -> tuple[int, int]:
    """Major and minor version in a text; a text without one counts as the oldest supported."""
    match = re.search(r"(\d+)\.(\d+)", text)
    return (int(match[1]), int(match[2])) if match else OLDEST


def _one_line(error: Exception) -> str:
    """Type and first line of an error, as compiler messages are long."""
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {first[:300]}" if first else type(error).__name__
