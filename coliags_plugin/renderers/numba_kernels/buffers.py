"""Memory that is used again: fresh pages cost more than the kernels that fill them."""

from __future__ import annotations

import math
import weakref
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

#: Bytes that buffers begin at a multiple of: a line of the cache.
_ALIGNMENT = 64
#: A buffer that has to grow is made this much larger than asked for.
_GROWTH = 1.25
#: Buffers of results kept for later.
_KEPT_RESULTS = 32
#: Arenas kept for later. One graph alive at a time, as in training, needs two: the next is built before the last goes.
_KEPT = 2


def aligned(size: int) -> npt.NDArray[np.uint8]:
    """Fresh memory for at least ``size`` bytes."""
    raw = np.empty(size + 2 * _ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % _ALIGNMENT
    return raw[start : start + -(-size // _ALIGNMENT) * _ALIGNMENT]


class Arena:
    """Named buffers of one view. What is in them when they are taken is not defined."""

    def __init__(self) -> None:
        self._bytes: dict[str, npt.NDArray[np.uint8]] = {}

    def take(self, name: str, size: int, dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
        """A flat array. It shares its memory with whatever was taken under this name before."""
        wanted = size * np.dtype(dtype).itemsize
        buffer = self._bytes.get(name)
        if buffer is None or len(buffer) < wanted:
            buffer = self._bytes[name] = aligned(int(wanted * _GROWTH))
        return buffer[:wanted].view(dtype)


class ArenaPool:
    """Arenas lent to whoever needs one, for as long as that lives.

    Safe to use from several threads, and without a lock: arenas come back whenever Python collects garbage, which may
    be in the middle of :meth:`lend`.
    """

    def __init__(self) -> None:
        self._free: deque[Arena] = deque(maxlen=_KEPT)

    def lend(self, borrower: object) -> Arena:
        """An arena that comes back when ``borrower`` is collected."""
        try:
            arena = self._free.pop()
        except IndexError:
            arena = Arena()
        weakref.finalize(borrower, self._free.append, arena).atexit = False
        return arena


class Results:
    """Arrays to hand out. Their memory comes back when nobody holds them any longer."""

    def __init__(self) -> None:
        self._free: deque[npt.NDArray[np.uint8]] = deque(maxlen=_KEPT_RESULTS)

    def take(self, *shape: int) -> npt.NDArray[np.float32]:
        """A float32 array; what is in it is not defined."""
        wanted = 4 * math.prod(shape)
        buffer = None
        for _ in range(len(self._free)):
            try:
                candidate = self._free.popleft()
            except IndexError:
                break
            if wanted <= len(candidate) <= 2 * wanted:
                buffer = candidate
                break
            self._free.append(candidate)
        if buffer is None:
            buffer = aligned(int(wanted * _GROWTH))
        # Views of views refer to the first array that does not refer to another: this one, because of the memoryview.
        array = np.frombuffer(memoryview(buffer)[:wanted], np.float32)
        weakref.finalize(array, self._free.append, buffer).atexit = False
        return array.reshape(shape)
