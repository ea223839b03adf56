"""File operations that fail, stop short or kill the process, for tests of everything that writes."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from coliags_plugin.core import files

#: Operations that change the disk: of the module ``os``, and the functions ``mkdtemp`` and ``open``.
COUNTED = ("mkdir", "mkdtemp", "fsync", "replace", "rename", "open", "write")


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

    def __init__(self, file: Any, faults: Faults) -> None:
        self._file, self._faults = file, faults

    def write(self, data: bytes) -> int:
        if self._faults.is_due():
            self._file.write(data[: len(data) // 2])
            self._file.flush()
            self._faults.fault()
        return int(self._file.write(data))

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


class Faults:
    """File operations of the package, one of which goes wrong.

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
        """True if there were so many operations."""
        return self.seen > self.when

    def counted(self, operation: Callable[..., Any]) -> Callable[..., Any]:
        """The operation, or the fault where it is due."""

        def wrapped(*args: Any, **options: Any) -> Any:
            if self.is_due():
                self.fault()
            return operation(*args, **options)

        return wrapped

    def open(self, path: Path, mode: str) -> _File:
        """The built-in function, whose files may fail."""
        return _File(self.counted(open)(path, mode), self)


@contextmanager
def fault(when: int, kind: Callable[[], None]) -> Iterator[Faults]:
    """Let one file operation of the package go wrong."""
    faults = Faults(when, kind)
    counted = {name: faults.counted(operation) for name, operation in vars(os).items() if name in COUNTED}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "os", SimpleNamespace(**{**vars(os), **counted, "open": os.open}))
        patch.setattr(files, "mkdtemp", faults.counted(files.mkdtemp))
        patch.setattr(files, "open", faults.open, raising=False)
        yield faults


def content(path: Path) -> bytes | dict[str, bytes] | None:
    """Bytes of a file, or of all files of a folder by name; None where there is nothing."""
    if path.is_dir():
        return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
    return path.read_bytes() if path.exists() else None
