"""Atomic writes: files and folders are written under a temporary name, forced onto the disk, and then renamed.

So a target is either as it was or whole, whatever happens: an error, a full disk, a kill.
"""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from coliags_plugin.core.errors import InputError, NotWritableError
from coliags_plugin.core.scratch import (
    final_place,
    is_in_scratch,
    put_in_place,
    scratch_file,
    scratch_folder,
    sweep,
    sync,
    sync_tree,
)

if TYPE_CHECKING:
    import numpy as np

#: Errors of a disk, quota or size limit that is used up.
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def refuse_overlap(output: Path, source: Path) -> None:
    """Refuse an output folder that is, contains or is inside the input."""
    made, read = output.resolve(), source.resolve()
    if made == read or made in read.parents or read in made.parents:
        raise InputError(
            f"--output {output}, and the input is {source}", "a folder apart from the input", "Choose another"
        )


@contextmanager
def atomic_folder(target: Path, overwrite: bool = False) -> Iterator[Path]:
    """Scratch folder that becomes ``target`` when the block ends without an error; first, killed ones are removed."""
    durable = not is_in_scratch(target)
    make_folder(target.parent)
    with ExitStack() as scratches:
        with reporting_unwritable(target.parent):
            if durable:
                sweep(target)
            if not overwrite and target.exists() and (not target.is_dir() or any(target.iterdir())):
                raise InputError(
                    f"{target} already exists", "a new or empty folder", "Choose another, or pass --overwrite"
                )
            scratch = scratches.enter_context(scratch_folder(target))
        with reporting_unwritable(target.parent, only_full=True):
            yield scratch
        with reporting_unwritable(target.parent):
            if durable:
                sync_tree(scratch)
            put_in_place(scratch, target)
            if durable:
                sync(target.parent)


def atomic_write(target: Path, data: bytes | str) -> None:
    """Write a file under a temporary name, then rename it to ``target``."""
    with _renamed_at_the_end(target) as file:
        file.write(data.encode() if isinstance(data, str) else data)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """A path of the same suffix for a library to write; it becomes ``target`` when the block ends without an error."""
    make_folder(target.parent)
    with ExitStack() as scratches:
        with reporting_unwritable(target.parent):
            sweep(target)
            path = scratches.enter_context(scratch_folder(target)) / target.name
        with reporting_unwritable(target.parent, only_full=True):
            yield path
        with reporting_unwritable(target.parent):
            sync(path)
            os.replace(path, target)
            sync(target.parent)


def atomic_copy(source: Path, target: Path) -> None:
    """Copy a file under a temporary name, then rename that to ``target``."""
    with source.open("rb") as original, _renamed_at_the_end(target) as file:
        shutil.copyfileobj(original, file)


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where that is not possible, as on another disk; for scratch folders."""
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


@contextmanager
def _renamed_at_the_end(target: Path) -> Iterator[IO[bytes]]:
    durable, scratch = not is_in_scratch(target), None
    make_folder(target.parent)
    try:
        with reporting_unwritable(target.parent):
            if durable:
                sweep(target)
            handle, scratch = scratch_file(target)
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                if durable:
                    os.fsync(handle)
                os.replace(scratch, target)
            if durable:
                sync(target.parent)
    finally:
        if scratch is not None:
            scratch.unlink(missing_ok=True)


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
    seen = f"cannot write to {final_place(folder)}: {error.strerror or error}"
    if error.errno in _FULL:
        return NotWritableError(seen, "a disk with space left", "Free some, or choose another output")
    return NotWritableError(seen, "a writable folder", "Choose another output")
