"""Copies from the host to a device that do not wait for the work queued there."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


def constant(values: tuple[Any, ...], like: Tensor) -> Tensor:
    """A tensor of numbers, nested in tuples, of the dtype and on the device of another; not to be changed.

    ``like.new_tensor`` copies each time, which on CUDA waits; this one is kept from call to call.
    """
    return _kept(values, like.dtype, like.device)


@lru_cache(maxsize=1024)
def _kept(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # an inference tensor could not take part in a later backward pass
        return torch.tensor(values, dtype=dtype, device=device)


def sent(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on a device; one of the CPU goes to CUDA through pinned memory, for which the host does not wait."""
    if tensor.device.type == "cpu" and torch.device(device).type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)
