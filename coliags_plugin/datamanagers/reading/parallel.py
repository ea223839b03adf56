"""Thread pool for work on many items, such as reading and decoding files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from coliags_plugin.core.progress import Progress, with_progress

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Largest number of threads: more would wait for the disk.
_READERS = 8


def parallel_map(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    what: str,
    progress: Progress | None = None,
    threads: int | None = None,
) -> list[_Result]:
    """Apply a function to every item in a thread pool and return the results in order; they are all held in memory.

    ``what`` names the task for ``progress``. ``threads`` is by default what reads files fastest. The exception of the
    first item that fails is raised, and the remaining items are cancelled.
    """
    with ThreadPoolExecutor(threads or min(_READERS, os.cpu_count() or 1)) as pool:
        pending = [pool.submit(function, item) for item in items]
        try:
            return [future.result() for future in with_progress(pending, what, progress)]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
