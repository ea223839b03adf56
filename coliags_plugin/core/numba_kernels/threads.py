"""Thread pool and dynamic distribution of work for the kernels."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import numpy as np
import torch
from numba.core import types

from coliags_plugin.core.numba_kernels.compilation import part
from coliags_plugin.core.numba_kernels.lanes import INDEX, INTEGER, INTEGERS, operation


@operation(types.int64, INTEGERS, INDEX, INTEGER)
def take(builder, counters, index, amount):
    """Atomically add to ``counters[index]`` and return the previous value."""
    return builder.atomic_rmw("add", builder.gep(counters, [index]), amount, "monotonic")


@part
def pieces(counters, index, end, step=1):
    """Iterate over the pieces of work 0, ``step``, ... before ``end`` that this thread is the first to take."""
    piece = take(counters, index, step)
    while piece < end:
        yield piece
        piece = take(counters, index, step)


class Crew:
    """Threads, as many as torch uses, that run one kernel after the other; several crews may work at once.

    Every thread calls the kernel with the same arguments, of which four work counters are the first, and the kernel takes
    pieces of work with :func:`take` until none are left. The calling thread works too and waits only for threads that have
    started: those that the system has not scheduled by then are cancelled.
    """

    _pool: ClassVar[ThreadPoolExecutor]

    def __init__(self) -> None:
        self.size = torch.get_num_threads()

    @classmethod
    def assemble(cls) -> None:
        """Make the threads: at first, and anew in a forked process, as a fork copies locks but not threads."""
        cls._pool = ThreadPoolExecutor(max_workers=max(1, os.cpu_count() or 1), thread_name_prefix="numba-kernels")

    def run(self, kernel: Callable[..., None], *arguments: object) -> None:
        """Run a kernel to its end."""
        counters = np.zeros(4, np.int64)
        helpers = [self._pool.submit(kernel, counters, *arguments) for _ in range(self.size - 1)]
        try:
            kernel(counters, *arguments)
        finally:  # also on Ctrl-C: no thread may still write to memory that is about to be released
            for helper in helpers:
                if not helper.cancel():
                    helper.result()


Crew.assemble()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=Crew.assemble)
