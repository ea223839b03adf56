"""Choice and names of devices to compute on."""

from __future__ import annotations

import platform
from pathlib import Path

import torch

from coliags_plugin.core.errors import InputError


def choose_device(wanted: str) -> torch.device:
    """The torch device; ``auto`` prefers CUDA."""
    if wanted == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda was requested, but torch finds none", "cpu, or auto", "See `coliags doctor`")
    return torch.device(wanted)


def device_name(device: torch.device) -> str:
    """Model name of the GPU, or of the processor; of its architecture where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
