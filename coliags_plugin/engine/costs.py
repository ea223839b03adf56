"""Measurement of what training and rendering cost, and trimming of the heap."""

from __future__ import annotations

import ctypes
import mmap
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict

from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.engine.devices import device_name

#: PSNR of training views whose first reaching is timed, dB.
PSNR_MARKS = (25, 30, 32, 34, 36, 38, 40)
#: Growth of the resident set size after which the heap is trimmed, bytes.
GROWTH = 512 * 2**20


class TrainingCost(BaseModel):
    """Cost of training up to a checkpoint, all resumptions together; kept in the checkpoint. None: not measured.

    Time is that in the training loop: steps, logging and earlier checkpoints, without what a kill threw away. Memory is
    the largest resident memory of the process; on a GPU, the largest memory allocated there in the loop.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    device: str  # name of the processor or GPU
    threads: int | None = None  # of torch, on the CPU
    seconds: float | None = None
    processor_seconds: float | None = None  # all threads together
    peak_memory_mib: float | None = None


class CostMeter:
    """Measures the cost of a training loop on top of what earlier parts of the run cost (None where it begins).

    Reading a clock and the memory takes microseconds.
    """

    def __init__(self, device: torch.device, earlier: TrainingCost | None = None) -> None:
        self._device, self._cost = device, earlier
        self._began: tuple[float, float] | None = None

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what is spent in the block."""
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self._device)
        self._began = _clocks()
        try:
            yield
        finally:
            self._cost, self._began = self.cost(), None

    @property
    def seconds(self) -> float:
        """Time of the run so far, of which nothing is missing that was measured."""
        earlier = 0.0 if self._cost is None else self._cost.seconds or 0.0
        return earlier if self._began is None else earlier + _clocks()[0] - self._began[0]

    def cost(self) -> TrainingCost | None:
        """Cost of the run so far; None where nothing was measured."""
        if self._began is None:
            return self._cost
        seconds, processor_seconds = (now - then for now, then in zip(_clocks(), self._began, strict=True))
        earlier = self._cost or TrainingCost(device="", seconds=0.0, processor_seconds=0.0, peak_memory_mib=0.0)
        peak, before = peak_memory_mib(self._device), earlier.peak_memory_mib
        return TrainingCost(
            device=device_name(self._device),
            threads=torch.get_num_threads(),
            seconds=(earlier.seconds or 0.0) + seconds,
            processor_seconds=(earlier.processor_seconds or 0.0) + processor_seconds,
            peak_memory_mib=None if peak is None or before is None else max(peak, before),
        )


def _clocks() -> tuple[float, float]:
    return time.monotonic(), time.process_time()


def peak_memory_mib(device: torch.device) -> float | None:
    """Largest resident memory of this process so far; on a GPU, largest memory allocated since its statistics began.

    None where the system does not tell.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    try:  # of this process alone: getrusage counts what its parent had when it was started
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**10
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:  # on Windows
        return None
    unit = 1 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


class RenderMeter:
    """Measures the rendering of single views, waiting for the device before and after each."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._seconds: list[float] = []
        self._drawn: list[int] = []

    def render(self, view: Callable[[], RenderOutput]) -> RenderOutput:
        """Call ``view``, which renders a view and does nothing else, and measure it."""
        self._wait()
        began = time.perf_counter()
        output = view()
        self._wait()
        self._seconds.append(time.perf_counter() - began)
        if output.splats is not None:
            self._drawn.append(int((output.splats.radii > 0).sum()))
        return output

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)

    @property
    def fps(self) -> float | None:
        """1 / the median time of a view; the first, which may compile and allocate, only counts where it is alone."""
        return 1.0 / median(self._seconds[1:] or self._seconds) if self._seconds else None

    @property
    def gaussians(self) -> float | None:
        """Mean number of Gaussians drawn in a view; None where none are rendered."""
        return fmean(self._drawn) if self._drawn else None


def seconds_to_psnr(rows: Sequence[Mapping[str, Any]], frames: int) -> dict[str, float | None]:
    """Training seconds at which the smoothed PSNR first reached each of :data:`PSNR_MARKS`; None where it never did.

    Smoothed is the mean over the logged rows of the last ``frames`` steps (the number of training frames), one pass
    where a step draws one frame, from the end of the first pass on. Rows ascend by step; empty without rows.
    """
    if not rows:
        return {}
    steps, psnr, seconds = (np.array([row[name] for row in rows], dtype=float) for name in ("step", "psnr", "seconds"))
    first = np.searchsorted(steps, steps - frames, side="right")
    # Each rounded once: differences of running sums may miss a mark that is reached exactly.
    smoothed = np.array([fmean(psnr[begin : end + 1]) for end, begin in enumerate(first)])
    times: dict[str, float | None] = {}
    for mark in PSNR_MARKS:
        reached = seconds[(steps >= frames) & (smoothed >= mark)]
        times[str(mark)] = float(reached[0]) if len(reached) else None
    return times


class HeapTrimmer:
    """Returns freed heap memory to the operating system whenever the resident set size has grown by :data:`GROWTH`.

    Tensors of some MiB that every step allocates and frees can fragment the heap of glibc 2.36 so that the next ones do
    not fit: processes that used .25 GiB grew to 23. Where the C library has no ``malloc_trim``, or the system no
    ``/proc``, nothing is done.
    """

    def __init__(self) -> None:
        self._malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
        self._limit = resident_memory() + GROWTH

    def trim_if_grown(self) -> None:
        """Trim the heap if the process has grown; takes microseconds if it has not."""
        if self._malloc_trim is not None and resident_memory() > self._limit:
            self._malloc_trim(0)
            self._limit = resident_memory() + GROWTH


def resident_memory() -> int:
    """Resident set size (RSS) of this process in bytes, 0 where ``/proc`` does not exist."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * mmap.PAGESIZE
    except OSError:
        return 0
