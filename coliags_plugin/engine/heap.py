"""Freed memory that the C library keeps, given back to the system."""

from __future__ import annotations

import ctypes
import mmap
import sys
from pathlib import Path

#: How far the resident memory of the process may grow before free memory is given back, bytes.
GROWTH = 512 * 2**20


class FreeMemory:
    """Gives freed memory back to the system whenever the process has grown by :data:`GROWTH`.

    Tensors of some MiB that every step makes and frees can split the heap of glibc 2.36 so that the next ones do not
    fit: processes that used .25 GiB grew to 23. Where the C library has no ``malloc_trim``, or the system no ``/proc``,
    nothing is done.
    """

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
        self._limit = resident_memory() + GROWTH

    def give_back(self) -> None:
        """Give free memory back if the process has grown; takes microseconds if it has not."""
        if self._trim is not None and resident_memory() > self._limit:
            self._trim(0)
            self._limit = resident_memory() + GROWTH


def resident_memory() -> int:
    """Resident memory of this process in bytes; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * mmap.PAGESIZE
    except OSError:
        return 0
