"""Atomic writes: files and folders are written under a temporary name and then renamed."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from coliags_plugin.core.errors import InputError


@contextmanager
def atomic_folder(target: Path, overwrite: bool = False) -> Iterator[Path]:
    """Temporary folder that is renamed to ``target`` when the block ends without an error.

    Args:
        target: The folder to create, with its parents.
        overwrite: Replace an existing folder.

    Raises:
        InputError: ``target`` exists and ``overwrite`` is off, or its parent cannot be written.
    """
    if not overwrite and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target} already exists", "a new or empty folder", "Choose another, or pass --overwrite")
    make_folder(target.parent)
    try:
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise not_writable(target.parent, error) from error
    try:
        yield scratch
        scratch.chmod(0o755)
        replaced = None
        if target.exists():
            replaced = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
            target.rename(replaced / target.name)
        scratch.rename(target)
        if replaced is not None:
            shutil.rmtree(replaced)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise


def atomic_write(target: Path, data: bytes | str) -> None:
    """Write a file under a temporary name, then rename it to ``target``.

    Raises:
        InputError: The folder cannot be written.
    """
    with _renamed_at_the_end(target) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def atomic_copy(source: Path, target: Path) -> None:
    """Copy a file under a temporary name, then rename that to ``target``.

    Raises:
        InputError: The folder cannot be written.
    """
    with source.open("rb") as original, _renamed_at_the_end(target) as file:
        shutil.copyfileobj(original, file)


@contextmanager
def _renamed_at_the_end(target: Path) -> Iterator[IO[bytes]]:
    make_folder(target.parent)
    scratch = None
    try:
        handle, scratch = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
        with os.fdopen(handle, "wb") as file:
            yield file
        os.chmod(scratch, 0o644)
        os.replace(scratch, target)
        scratch = None
    except OSError as error:
        raise not_writable(target.parent, error) from error
    finally:
        if scratch is not None:
            Path(scratch).unlink(missing_ok=True)


def write_json(target: Path, data: Any) -> None:
    """Write indented JSON atomically; NaN and infinity are refused, as the JSON standard has neither."""
    atomic_write(target, json.dumps(data, indent=2, allow_nan=False) + "\n")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents.

    Raises:
        InputError: It cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_writable(folder, error) from error


def not_writable(folder: Path, error: OSError) -> InputError:
    """The error for a folder that cannot be written."""
    return InputError(
        f"cannot write to {folder}: {error.strerror or error}", "a writable folder", "Choose another output"
    )
