"""Tensors as the tables of kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from coliags_plugin.core.triton_support import what_triton_lacks


def fit_kernels(*tensors: Tensor) -> bool:
    """Whether kernels compiled by numba can compute with these tensors: float32 on the CPU."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def fit_triton_kernels(*tensors: Tensor) -> bool:
    """Whether kernels compiled by triton can compute with these tensors: float32 on CUDA, where it can launch them."""
    on_device = all(tensor.device.type == "cuda" and tensor.dtype == torch.float32 for tensor in tensors)
    return on_device and what_triton_lacks() is None


def tables(*tensors: Tensor) -> list[npt.NDArray[Any]]:
    """The numbers of CPU tensors as flat arrays for numba, which share the memory of contiguous ones."""
    return [np.asarray(tensor.detach().contiguous()).reshape(-1) for tensor in tensors]
