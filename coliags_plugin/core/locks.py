"""Locks between processes, also of several machines that share a file system."""

from __future__ import annotations

import fcntl
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from coliags_plugin.core.files import make_folder, not_writable

#: Between two attempts, seconds.
_PAUSE = 0.2


class LockedError(Exception):
    """Another process holds a lock; the message names it."""


@contextmanager
def locked(file: Path, wait: float = 0.0, waiting: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the lock of a file, which ends with the process, however that ends. The file stays.

    Args:
        file: Created where it is missing; holds the name of the process that has the lock.
        wait: Seconds to wait for another process.
        waiting: Called with the name of that process, once, before waiting.

    Raises:
        LockedError: Another process still holds it.
        InputError: The file cannot be written.
    """
    make_folder(file.parent)
    try:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise not_writable(file.parent, error) from error
    try:
        _acquire(handle, wait, waiting)
        began = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        holder = f"process {os.getpid()} on {platform.node()} since {began}".encode()
        os.ftruncate(handle, os.pwrite(handle, holder, 0))
        yield
    finally:
        os.close(handle)


def _acquire(handle: int, wait: float, waiting: Callable[[str], None] | None) -> None:
    until, told = time.monotonic() + wait, False
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            holder = os.pread(handle, 200, 0).decode(errors="replace") or "another process"
            if time.monotonic() >= until:
                raise LockedError(holder) from error
        if waiting is not None and not told:
            waiting(holder)
            told = True
        time.sleep(_PAUSE)
