"""Scratch files and folders beside what they will replace, and their removal after a kill.

A scratch file or folder is named ``.NAME.XXXXXXXX.partial`` and locked by the process that fills it, so that others can
tell what a killed process has left from what is still being written.
"""

from __future__ import annotations

import ctypes
import errno
import logging
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

logger = logging.getLogger(__name__)

_PARTIAL, _REPLACED = ".partial", ".replaced"
_SCRATCH = re.compile(r"\.(.+)\.[0-9a-f]{8}\.(?:partial|replaced)")
#: renameat2's "relative to the working directory" and "exchange both names", from Linux's headers.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def is_in_scratch(path: Path) -> bool:
    """Whether a path lies in a scratch folder, whose content is made durable as a whole."""
    return any(_SCRATCH.fullmatch(part) for part in path.parts[:-1])


def final_place(path: Path) -> Path:
    """The path that one in scratch folders will have."""
    return Path(*(found[1] if (found := _SCRATCH.fullmatch(part)) else part for part in path.parts))


@contextmanager
def scratch_folder(target: Path) -> Iterator[Path]:
    """A new, locked, empty folder beside ``target``, with the permissions that the umask leaves.

    It is removed at the end, with what it then holds, unless it was renamed.
    """
    while True:
        path = _name(target, _PARTIAL)
        os.mkdir(path)
        handle = os.open(path, os.O_RDONLY)
        try:
            if not _lock(handle, path):
                continue
            try:
                yield path
            finally:
                _remove(path)
            return
        finally:
            os.close(handle)


def scratch_file(target: Path) -> tuple[int, Path]:
    """A new, locked, empty file beside ``target``, with the permissions that the umask leaves: descriptor and path."""
    while True:
        path = _name(target, _PARTIAL)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if _lock(handle, path):
            return handle, path
        os.close(handle)


def _name(target: Path, suffix: str) -> Path:
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}{suffix}")


def _lock(handle: int, path: Path) -> bool:
    """Lock a new scratch; False where another process took it for a dead one's and removed it before that."""
    try:
        lock_descriptor(handle)
    except OSError:
        return True  # no locks on this file system: nothing is ever swept there either
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def sweep(target: Path) -> None:
    """Remove what killed processes have left beside ``target``; restore it if one was killed while replacing it."""
    for name in sorted(os.listdir(target.parent)):
        found = _SCRATCH.fullmatch(name)
        if found is None or found[1] != target.name:
            continue
        path = target.parent / name
        if path.suffix == _REPLACED and not os.path.lexists(target):
            logger.warning("%s was being replaced when its process was killed; restored", target)
            os.rename(path, target)
        elif _is_abandoned(path):
            _remove(path)


def _is_abandoned(path: Path) -> bool:
    """Whether no process holds the lock of a scratch."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        return lock_descriptor(handle, blocking=False)
    except OSError:
        return False
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def put_in_place(scratch: Path, target: Path) -> None:
    """Rename a scratch folder to ``target``; what was there takes the scratch's name.

    Atomic on Linux; elsewhere, a process killed between two renames leaves what :func:`sweep` restores. After
    an OSError, ``target`` is as it was.
    """
    if not os.path.lexists(target):
        os.rename(scratch, target)
    elif not _exchanged(scratch, target):
        replaced = _name(target, _REPLACED)
        os.rename(target, replaced)
        try:
            os.rename(scratch, target)
        except OSError:
            os.rename(replaced, target)
            raise
        _remove(replaced)


def _exchanged(one: Path, other: Path) -> bool:
    """Exchange two names; False where the system cannot."""
    exchange = _renameat2()
    if exchange is None:
        return False
    if exchange(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.EXDEV, errno.EOPNOTSUPP):
        return False
    raise OSError(code, os.strerror(code), str(other))


@cache
def _renameat2() -> Any:
    """Linux's system call of that name; None where there is none."""
    return getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)


def sync(path: Path) -> None:
    """Force a file, or the names in a folder, onto the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF):  # folders on some file systems
            raise
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Force a folder with all its content onto the disk."""
    for parent, _, files in os.walk(folder):
        for name in files:
            sync(Path(parent, name))
        sync(Path(parent))
