"""Many files at once: reading and decoding wait for disks and leave processors idle otherwise."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from coliags_plugin.core.progress import Progress

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Files read at once at most: more threads than this wait for the disk.
_READERS = 8


def side_by_side(
    function: Callable[[_Item], _Result], items: Sequence[_Item], what: str, progress: Progress | None = None
) -> list[_Result]:
    """What a function gives for each item, in their order; it is called from several threads.

    Results are held until all are there: keep them small.

    Args:
        function: Reads and digests one item.
        items: What to call it with.
        what: The job's name, for ``progress``.
        progress: Told how much is done.

    Raises:
        Exception: What the function raised for the first item it failed with; the rest is left undone.
    """
    results = []
    with ThreadPoolExecutor(min(_READERS, os.cpu_count() or 1)) as pool:
        pending = [pool.submit(function, item) for item in items]
        try:
            for done, future in enumerate(pending, start=1):
                results.append(future.result())
                if progress is not None:
                    progress(what, done, len(pending))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
