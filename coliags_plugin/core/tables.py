"""Flat tables of tensors for compiled kernels, and which tensors these can compute with."""

from __future__ import annotations

import os
import shutil
import sysconfig
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

#: The oldest release of triton that all kernels compile with; PyTorch 2.11 brings it.
OLDEST = (3, 6)


@cache
def what_triton_lacks() -> str | None:
    """Why triton cannot launch kernels on this machine, and what to do; None where it can.

    At first use it compiles the C code that calls the driver.
    """
    if find_spec("triton") is None:
        return "triton is not installed; PyTorch for CUDA on Linux brings it"
    import triton

    if tuple(int(part) for part in triton.__version__.split(".")[:2]) < OLDEST:
        return f"triton {triton.__version__} is older than {'.'.join(map(str, OLDEST))}, which PyTorch 2.11 brings"
    if os.environ.get("CC") is None and shutil.which("gcc") is None and shutil.which("clang") is None:
        return "triton finds no C compiler to call the driver by: install gcc, or name one in CC"
    scheme = sysconfig.get_default_scheme()
    header = Path(sysconfig.get_paths("posix_prefix" if scheme == "posix_local" else scheme)["include"], "Python.h")
    if not header.is_file():
        return f"triton needs {header}, the headers of Python: install python3-dev or the like"
    return None


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
