"""Choice of an executor from options."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal, get_args

from coliags_plugin.core.errors import check_name, check_number
from coliags_plugin.engine.devices import find_device
from coliags_plugin.execution.executors import Executor, LocalExecutor
from coliags_plugin.execution.ray_executor import RayExecutor

ExecutorName = Literal["local", "ray"]


@dataclass(frozen=True)
class ExecutionOptions:
    """Where and how tasks are run."""

    jobs: int | None = None  # tasks at a time; None: one per CPU, or per GPU
    threads: int | None = None  # CPU threads of each; None: the CPUs divided by the tasks at a time
    device: str = "auto"
    executor: str = "local"
    ray_address: str | None = None  # HOST:PORT of the head; None: RAY_ADDRESS, or the cluster of this machine
    retries: int = 2  # how often a task whose process died is tried again
    save_seconds: float = 60.0  # largest time between two checkpoints of training


def make_executor(options: ExecutionOptions) -> Executor:
    """The executor that options name."""
    check_number("jobs", options.jobs)
    check_number("threads", options.threads)
    check_number("retries", options.retries, least=0)
    check_name("executor", options.executor, get_args(ExecutorName))
    if options.executor == "ray":
        return RayExecutor(options.ray_address, options.jobs, options.threads or 1, options.device)
    cpus = available_cpus()
    gpus = _gpus(options.device)
    jobs = options.jobs or len(gpus) or cpus
    return LocalExecutor(jobs, options.threads or max(1, cpus // jobs), gpus)


def available_cpus() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gpus(device: str) -> list[str]:
    """Identifiers of the GPUs to use, as in ``CUDA_VISIBLE_DEVICES``: all, or the one that ``device`` numbers."""
    import torch

    chosen = find_device(device)
    if chosen.type != "cuda":
        return []
    visible = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
    found = (visible or list(map(str, range(torch.cuda.device_count()))))[: torch.cuda.device_count()]
    return [found[chosen.index]] if ":" in device else found
