"""Sharing out work among threads while they run."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def take(typingctx: Any, counters: Any, index: Any, amount: Any) -> Any:
    """Add to ``counters[index]`` in one step that no other thread can interrupt, and give what was there before."""
    if not (isinstance(counters, types.Array) and counters.dtype == types.int64 and counters.ndim == 1):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Sequence[Any]) -> Any:
        table, place, amount = arguments
        data = context.make_array(signature.args[0])(context, builder, table).data
        return builder.atomic_rmw("add", builder.gep(data, [place]), amount, "monotonic")

    return types.int64(counters, types.intp, types.int64), generate


class Crew:
    """Threads that run one kernel together.

    Every thread calls the kernel with the same arguments, and the kernel takes pieces of work with :func:`take` until
    none are left. Whoever asks works too and waits only for those who have begun: a thread that the system has not let
    run by then is not needed.

    A fork leaves threads behind, and takes locks along as they are. The forked process begins with a fresh crew.

    Attributes:
        turn: To be held while the crew is at work for one caller.
    """

    def __init__(self) -> None:
        self._assemble()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._assemble)

    def _assemble(self) -> None:
        self.turn = threading.Lock()
        self._threads = ThreadPoolExecutor(max_workers=max(1, os.cpu_count() or 1), thread_name_prefix="splatting")

    def run(self, size: int, kernel: Callable[..., Any], *arguments: Any) -> None:
        """Run a kernel on ``size`` threads, this one among them."""
        helpers = [self._threads.submit(kernel, *arguments) for _ in range(size - 1)]
        try:
            kernel(*arguments)
        finally:  # also on Ctrl-C: nobody may go on writing to memory that is about to be given away
            for helper in helpers:
                if not helper.cancel():
                    helper.result()
