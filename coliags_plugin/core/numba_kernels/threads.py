"""Thread pool and dynamic distribution of work for the kernels."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

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
    """Thread pool that runs one kernel on several threads.

    Every thread calls the kernel with the same arguments, and the kernel takes pieces of work with :func:`take` until
    none are left. The calling thread works too and waits only for threads that have started: those that the system has
    not scheduled by then are cancelled.

    A fork does not copy threads, but copies locks in their current state; so a forked process creates a new pool.

    Attributes:
        turn: Lock to hold while a caller uses the pool.
    """

    def __init__(self) -> None:
        self._assemble()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._assemble)

    def _assemble(self) -> None:
        self.turn = threading.Lock()
        self._threads = ThreadPoolExecutor(max_workers=max(1, os.cpu_count() or 1), thread_name_prefix="numba-kernels")

    def run(self, size: int, kernel: Callable[..., None], *arguments: object) -> None:
        """Run a kernel on ``size`` threads, including the calling one."""
        helpers = [self._threads.submit(kernel, *arguments) for _ in range(size - 1)]
        try:
            kernel(*arguments)
        finally:  # also on Ctrl-C: no thread may still write to memory that is about to be released
            for helper in helpers:
                if not helper.cancel():
                    helper.result()


_crew = Crew()


class Runner:
    """Runs kernels on a given number of threads."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def __call__(self, kernel: Callable[..., Any], *arguments: Any) -> None:
        """Run a kernel, which gets four work counters first."""
        _crew.run(self.workers, kernel, np.zeros(4, np.int64), *arguments)


@contextmanager
def workers() -> Iterator[Runner]:
    """Exclusive use of the thread pool, with as many threads as torch uses."""
    with _crew.turn:
        yield Runner(torch.get_num_threads())
