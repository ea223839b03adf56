"""Trimming of the C library's heap (``malloc_trim``)."""

from __future__ import annotations

import ctypes
import mmap
import sys
from pathlib import Path

#: Growth of the resident set size after which the heap is trimmed, bytes.
GROWTH = 512 * 2**20


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
