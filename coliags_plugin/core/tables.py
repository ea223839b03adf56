"""Tensors as the tables of kernels."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


def fit_kernels(*tensors: Tensor) -> bool:
    """Whether kernels compiled by numba can compute with these tensors: float32 on the CPU."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def fit_triton_kernels(*tensors: Tensor) -> bool:
    """Whether kernels compiled by triton can compute with these tensors: float32 on CUDA, where triton is installed."""
    on_device = all(tensor.device.type == "cuda" and tensor.dtype == torch.float32 for tensor in tensors)
    return on_device and find_spec("triton") is not None


def tables(*tensors: Tensor) -> list[npt.NDArray[Any]]:
    """The numbers of CPU tensors as flat arrays for numba, which share the memory of contiguous ones."""
    return [np.asarray(tensor.detach().contiguous()).reshape(-1) for tensor in tensors]
