"""Choice and names of devices to compute on, and versions of the software that does."""

from __future__ import annotations

import platform
import re
import subprocess
from pathlib import Path

import torch

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.results.hashing import code_key


def find_device(name: str) -> torch.device:
    """The device of a name: ``cpu``, ``cuda:N``, ``cuda``, which is ``cuda:0``, or ``auto``, ``cuda`` if it is there.

    Raises:
        InputError: There is no such name, or no such device.
    """
    cuda = re.fullmatch(r"cuda(?::(\d+))?", name)
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if name != "auto" and cuda is None:
        raise InputError(f"device '{name}'", "auto, cpu, cuda or cuda:N, N being the number of a CUDA device")
    if not torch.cuda.is_available():
        problem = f"device {name} was requested, but torch finds none"
        raise InputError(problem, "cpu, or auto", "See `coliags check installation`")
    index, count = int((cuda and cuda[1]) or 0), torch.cuda.device_count()
    if index >= count:
        there = ", ".join(f"cuda:{number} ({torch.cuda.get_device_name(number)})" for number in range(count))
        raise InputError(f"device {name} was requested, but torch finds {there}", "one of these, cpu or auto")
    return torch.device("cuda", index)


def choose_device(name: str) -> torch.device:
    """:func:`find_device`, made the device that this thread launches kernels on."""
    device = find_device(name)
    make_current(device)
    return device


def make_current(device: torch.device) -> None:
    """Have this thread launch kernels on a CUDA device, as those of triton are launched on the current one.

    Every thread has its own; those of automatic differentiation follow the forward pass.
    """
    if device.type == "cuda":
        torch.cuda.set_device(device)


def device_name(device: torch.device) -> str:
    """Model name of the GPU, or of the processor; of its architecture where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def software() -> JsonObject:
    """Versions, the key of the code, and the git state where the package runs from a checkout."""
    return {
        "package_version": __version__,
        "code": code_key(),
        "git": _git_state(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
    }


def _git_state() -> str | None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
