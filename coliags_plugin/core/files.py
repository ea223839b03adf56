"""Atomic writes: files and folders are written under a temporary name, forced onto the disk, and then renamed.

So a target is either as it was or whole, whatever happens: an error, a full disk, a kill. Only a kill between the two
renames that replace a folder leaves none at its place: the next write there finds it and puts it back.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from glob import escape
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

from coliags_plugin.core.errors import InputError, NotWritableError

if TYPE_CHECKING:
    import numpy as np

log = logging.getLogger(__name__)

#: Name of the list of checksums of a folder, as ``sha256sum`` writes and checks it.
CHECKSUMS = "SHA256SUMS"
#: Scratch folders: of which name, and of which process.
_SCRATCH = re.compile(r"\.(.+)\.([0-9]+)-[a-z0-9_]+\.partial")
#: What was at the place of a folder that is being replaced, in its scratch folder.
_OLD = ".replaced"
#: Names of the scratch folders of this process.
_OWN: set[str] = set()
#: Errors of a disk, quota or size limit that is used up.
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def user_path(path: str | Path) -> Path:
    """The path with a leading ``~`` or ``~user`` replaced by the home folder; as it is where there is no such user."""
    return Path(os.path.expanduser(path))


def refuse_overlap(output: Path, source: Path) -> None:
    """Refuse an output folder that is, contains or is inside the input."""
    target, origin = output.resolve(), source.resolve()
    if target == origin or target in origin.parents or origin in target.parents:
        raise InputError(
            f"`output={output}`, and the input is {source}", "a folder apart from the input", "Choose another"
        )


def refuse_existing(target: Path, overwrite: bool, expected: str = "a new or empty folder") -> None:
    """Refuse an output that is there, unless it is an empty folder or may be overwritten."""
    if not overwrite and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target} already exists", expected, "Choose another, or pass `overwrite=True`")


@contextmanager
def atomic_folder(target: Path, overwrite: bool = False) -> Iterator[Path]:
    """Scratch folder that becomes ``target`` when the block ends without an error."""
    with _scratch(target) as path:
        with reporting_unwritable(target.parent):
            refuse_existing(target, overwrite)
            os.mkdir(path)
        with reporting_unwritable(target.parent, only_full=True):
            yield path
        with reporting_unwritable(target.parent):
            if not _is_in_scratch(target):
                for parent, _, files in os.walk(path):
                    for name in (*files, ""):
                        _sync(Path(parent, name))
            _put_folder(path, target)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """A path of the same name for a library to write; it becomes ``target`` when the block ends without an error."""
    with _scratch(target) as path:
        with reporting_unwritable(target.parent, only_full=True):
            yield path
        with reporting_unwritable(target.parent):
            _sync(path)
            os.replace(path, target)
            _sync(target.parent)


def atomic_write(target: Path, data: bytes | str) -> None:
    """Write a file under a temporary name, then rename it to ``target``."""
    content = data.encode() if isinstance(data, str) else data
    make_folder(target.parent)
    with nullcontext(target) if _is_in_scratch(target) else atomic_path(target) as path:
        with reporting_unwritable(target.parent), open(path, "wb") as file:
            file.write(content)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where that is not possible, as on another disk; for scratch folders."""
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


@contextmanager
def _scratch(target: Path) -> Iterator[Path]:
    """A path of the target's name in a new hidden folder beside it, which is removed at the end.

    The folder, ``.NAME.PID-XXXXXXXX.partial``, names the process, so that what a killed one has left can be removed.
    """
    make_folder(target.parent)
    with reporting_unwritable(target.parent):
        if not _is_in_scratch(target):
            _sweep(target)
        folder = Path(mkdtemp(prefix=f".{target.name}.{os.getpid()}-", suffix=".partial", dir=target.parent))
    _OWN.add(folder.name)
    try:
        yield folder / target.name
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _OWN.discard(folder.name)


def _sweep(target: Path) -> None:
    """Remove what killed processes have left beside ``target``; restore it if one was killed while replacing it."""
    for path in sorted(target.parent.glob(f"{escape(f'.{target.name}.')}*.partial")):
        scratch = _SCRATCH.fullmatch(path.name)
        if scratch is None or scratch[1] != target.name or path.name in _OWN or _is_running(int(scratch[2])):
            continue
        if (path / _OLD).exists() and not os.path.lexists(target):
            log.warning("%s was being replaced when its process was killed; restored", target)
            os.rename(path / _OLD, target)
        shutil.rmtree(path, ignore_errors=True)


def _is_running(process: int) -> bool:
    """True if another process of this number is running; in containers, this one may have a killed one's number."""
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _put_folder(path: Path, target: Path) -> None:
    """Rename a scratch folder to ``target``; what was there goes into the scratch first, and back after an error."""
    old = path.parent / _OLD
    if os.path.lexists(target):
        os.rename(target, old)
    try:
        os.rename(path, target)
    except OSError:
        if os.path.lexists(old):
            os.rename(old, target)
        raise
    if not _is_in_scratch(target):
        _sync(target.parent)


def _is_in_scratch(path: Path) -> bool:
    """True for a path in a scratch folder, which becomes durable and gets its name as a whole."""
    return any(_SCRATCH.fullmatch(part) for part in path.parts[:-1])


def final_place(path: Path) -> Path:
    """The path that one in scratch folders will have."""
    return Path(*(part for part in path.parts if not _SCRATCH.fullmatch(part)))


def _sync(path: Path) -> None:
    """Force a file, or the names in a folder, onto the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF):  # folders on some file systems
            raise
    finally:
        os.close(handle)


@contextmanager
def reporting_unwritable(folder: Path, only_full: bool = False) -> Iterator[None]:
    """Report that a folder cannot be written; or only a full disk, where other errors may not be about the folder."""
    try:
        yield
    except OSError as error:
        if only_full and error.errno not in _FULL:
            raise
        raise not_writable(folder, error) from error


def write_arrays(target: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as NPZ, atomically and without pickle."""
    import numpy as np

    data = io.BytesIO()
    np.savez(data, allow_pickle=False, **arrays)
    atomic_write(target, data.getvalue())


def write_json(target: Path, data: object) -> None:
    """Write indented JSON atomically; NaN and infinity are refused, as the JSON standard has neither."""
    atomic_write(target, json.dumps(data, indent=2, allow_nan=False) + "\n")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents."""
    with reporting_unwritable(folder):
        folder.mkdir(parents=True, exist_ok=True)


def not_writable(folder: Path, error: OSError) -> NotWritableError:
    """The error for a folder that cannot be written."""
    problem = f"cannot write to {final_place(folder)}: {error.strerror or error}"
    if error.errno in _FULL:
        return NotWritableError(problem, "a disk with space left", "Free some, or choose another output")
    return NotWritableError(problem, "a writable folder", "Choose another output")


def file_sha256(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}", "a readable file") from error
    return digest.hexdigest()


def write_checksums(folder: Path) -> None:
    """List the checksums of all files of a folder in a file of it, :data:`CHECKSUMS`."""
    names = sorted(path.name for path in folder.iterdir() if path.is_file() and path.name != CHECKSUMS)
    atomic_write(folder / CHECKSUMS, "".join(f"{file_sha256(folder / name)}  {name}\n" for name in names))


def differing_files(folder: Path) -> list[str]:
    """Names of files that are missing from a folder or are not those of its list of checksums; without a list, none."""
    try:
        lines = (folder / CHECKSUMS).read_text(encoding="ascii").splitlines()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError):
        return [CHECKSUMS]
    differing = []
    for line in lines:
        digest, _, name = line.partition("  ")
        if not name or "/" in name:
            return [CHECKSUMS]
        try:
            is_there = (folder / name).is_file()
        except OSError:  # the name is too long
            return [CHECKSUMS]
        if not is_there or file_sha256(folder / name) != digest:
            differing.append(name)
    return differing
