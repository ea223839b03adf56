"""File operations that fail, stop short or kill the process, for tests of everything that writes."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coliags_plugin.core import files, scratch

#: Operations that change the disk.
COUNTED = ("mkdir", "open", "fsync", "replace", "rename", "write")


def no_space() -> None:
    """The disk is full."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def broken_disk() -> None:
    """The disk does not answer."""
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def killed() -> None:
    """The process ends at once, as by SIGKILL."""
    os._exit(9)


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let no file of this process, or of those it starts, grow beyond so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class _File:
    """A file of which one write may store half of its data and then fail."""

    def __init__(self, file: Any, faulty: FaultyOs) -> None:
        self._file, self._faulty = file, faulty

    def write(self, data: bytes) -> int:
        if self._faulty.is_due():
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            self._faulty.fault()
        return int(self._file.write(data))

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


class FaultyOs:
    """The module ``os``, of which one operation that changes the disk goes wrong.

    Args:
        when: Which one, counted from 0 over all of :data:`COUNTED`.
        fault: Called instead of it.
    """

    def __init__(self, when: int, fault: Callable[[], None]) -> None:
        self.when, self.fault, self.seen = when, fault, 0

    def is_due(self) -> bool:
        """Count an operation; whether it is the one."""
        self.seen += 1
        return self.seen - 1 == self.when

    @property
    def has_struck(self) -> bool:
        """Whether there were so many operations."""
        return self.seen > self.when

    def fdopen(self, handle: int, mode: str) -> _File:
        return _File(os.fdopen(handle, mode), self)

    def __getattr__(self, name: str) -> Any:
        real = getattr(os, name)
        if name not in COUNTED:
            return real

        def counted(*args: Any, **options: Any) -> Any:
            if name == "open" and not args[1] & os.O_CREAT:
                return real(*args, **options)
            if self.is_due():
                self.fault()
            return real(*args, **options)

        return counted


@contextmanager
def fault(when: int, kind: Callable[[], None]) -> Iterator[FaultyOs]:
    """Let one file operation of the package go wrong."""
    faulty, real = FaultyOs(when, kind), os
    files.os = scratch.os = faulty  # type: ignore[assignment]
    try:
        yield faulty
    finally:
        files.os = scratch.os = real


def content(path: Path) -> bytes | dict[str, bytes] | None:
    """Bytes of a file, or of all files of a folder by name; None where there is nothing."""
    if path.is_dir():
        return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
    return path.read_bytes() if path.exists() else None
