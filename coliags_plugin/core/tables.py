"""Tensors as the tables of kernels compiled by numba."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


def fit_kernels(*tensors: Tensor) -> bool:
    """Whether kernels can compute with these tensors: float32 on the CPU."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def tables(*tensors: Tensor) -> list[npt.NDArray[Any]]:
    """The numbers of CPU tensors as flat arrays, which share the memory of contiguous ones."""
    return [np.asarray(tensor.detach().contiguous()).reshape(-1) for tensor in tensors]
