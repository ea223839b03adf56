"""Long jobs: progress callbacks, and locks between processes, also of machines that share a file system."""

from __future__ import annotations

import logging
import math
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import make_folder, not_writable

_Item = TypeVar("_Item")

#: Called with a description of the work, the number of units done, and their total.
Progress = Callable[[str, int, int], None]


def with_progress(items: Iterable[_Item], what: str, progress: Progress | None, expected: int = 0) -> Iterator[_Item]:
    """The items; each is reported when the next one is asked for. ``expected`` is about their number, if unknown."""
    total = len(items) if isinstance(items, Sized) else expected
    for done, item in enumerate(items, start=1):
        yield item
        if progress is not None:
            progress(what, done, max(done, total))


log = logging.getLogger(__name__)

#: Between two attempts, seconds.
_POLL_INTERVAL_S = 0.2


class LockedError(InputError):
    """Another process holds a lock; the message names it."""


@contextmanager
def locked(file: Path, what: str | Path, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file, which ends with the process, however that ends.

    The file names the process that has the lock; it is removed at the end, and stays after a kill. ``what`` it protects
    is for messages. Another process is waited for so many seconds, or without end; LockedError if it still holds the
    lock.
    """
    make_folder(file.parent)
    lock = FileLock(file, poll_interval=_POLL_INTERVAL_S)
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if wait <= 0.0:
                raise
            log.info("waiting for %s, which has %s", _holder(file), what)
            lock.acquire(timeout=-1 if math.isinf(wait) else wait)
    except Timeout as error:
        raise LockedError(
            f"{what} is in use by {_holder(file)}",
            "one process at a time",
            "Wait until it has ended, or choose another output",
        ) from error
    except OSError as error:
        raise not_writable(file.parent, error) from error
    try:
        began = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        with suppress(OSError):  # a full disk; on Windows a locked file
            file.write_text(f"process {os.getpid()} on {platform.node()} since {began}", encoding="utf-8")
        yield
    finally:
        with suppress(OSError):  # on Windows an open file
            file.unlink()  # before the release: who waits for the removed file opens the next one
        lock.release()


def _holder(file: Path) -> str:
    """The process that has a lock, as its file says."""
    with suppress(OSError):
        return file.read_text(encoding="utf-8", errors="replace") or "another process"
    return "another process"
