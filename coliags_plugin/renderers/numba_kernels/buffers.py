"""Reuse of memory buffers, as allocating new pages costs more than the kernels that fill them."""

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
    """Allocate aligned memory of at least ``size`` bytes."""
    raw = np.empty(size + 2 * _ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % _ALIGNMENT
    return raw[start : start + -(-size // _ALIGNMENT) * _ALIGNMENT]


class Arena:
    """Named buffers of one view, with undefined initial content."""

    def __init__(self) -> None:
        self._bytes: dict[str, npt.NDArray[np.uint8]] = {}

    def take(self, name: str, size: int, dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
        """Take a flat array, which shares its memory with earlier ones of this name."""
        length = size * np.dtype(dtype).itemsize
        buffer = self._bytes.get(name)
        if buffer is None or len(buffer) < length:
            buffer = self._bytes[name] = aligned(int(length * _GROWTH))
        return buffer[:length].view(dtype)


class ArenaPool:
    """Pool of arenas, each lent for the lifetime of its borrower.

    Safe to use from several threads, and without a lock: arenas come back whenever Python collects garbage, which may
    be in the middle of :meth:`lend`.
    """

    def __init__(self) -> None:
        self._free: deque[Arena] = deque(maxlen=_KEPT)

    def lend(self, borrower: object) -> Arena:
        """Lend an arena until ``borrower`` is garbage collected."""
        try:
            arena = self._free.pop()
        except IndexError:
            arena = Arena()
        weakref.finalize(borrower, self._free.append, arena).atexit = False
        return arena


class Results:
    """Allocator of result arrays, whose memory is reused after they are garbage collected."""

    def __init__(self) -> None:
        self._free: deque[npt.NDArray[np.uint8]] = deque(maxlen=_KEPT_RESULTS)

    def take(self, *shape: int) -> npt.NDArray[np.float32]:
        """Take a float32 array with undefined content."""
        length = 4 * math.prod(shape)
        buffer = None
        for _ in range(len(self._free)):
            try:
                candidate = self._free.popleft()
            except IndexError:
                break
            if length <= len(candidate) <= 2 * length:
                buffer = candidate
                break
            self._free.append(candidate)
        if buffer is None:
            buffer = aligned(int(length * _GROWTH))
        # Views of views refer to the first array that does not refer to another: this one, because of the memoryview.
        array = np.frombuffer(memoryview(buffer)[:length], np.float32)
        weakref.finalize(array, self._free.append, buffer).atexit = False
        return array.reshape(shape)
