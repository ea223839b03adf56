"""Choice of the device to compute on."""

from __future__ import annotations

import torch

from coliags_plugin.core.errors import InputError


def choose_device(wanted: str) -> torch.device:
    """The torch device; ``auto`` prefers CUDA.

    Raises:
        InputError: The device is not there.
    """
    if wanted == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda was requested, but torch finds none", "cpu, or auto", "See `coliags doctor`")
    return torch.device(wanted)
