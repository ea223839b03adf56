"""Libraries with habits of their own: open3d and triton, which may be missing, and image decoders, which print."""

from __future__ import annotations

import logging
import os
import shutil
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import find_spec
from io import UnsupportedOperation
from pathlib import Path
from typing import IO, Any

from coliags_plugin.core.errors import InputError

#: The oldest release of triton that all kernels compile with; PyTorch 2.11 brings it.
OLDEST_TRITON = (3, 6)


def import_open3d(purpose: str) -> Any:
    """open3d, which takes a second to import; in a notebook without its server of 3D views, which prints and listens.

    The purpose, what it does, is for the message where it cannot be imported.
    """
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"open3d cannot be imported ({error})",
            f"open3d, which {purpose}",
            "Install it with `pip install open3d`; on Debian and Ubuntu it also needs the package libusb-1.0-0",
        ) from error
    return open3d


@cache
def what_triton_lacks() -> str | None:
    """Why triton cannot launch kernels on this machine, and what to do; None where it can.

    At first use it compiles the C code that calls the driver.
    """
    if find_spec("triton") is None:
        return "triton is not installed; PyTorch for CUDA on Linux brings it"
    import triton

    if tuple(int(part) for part in triton.__version__.split(".")[:2]) < OLDEST_TRITON:
        return (
            f"triton {triton.__version__} is older than {'.'.join(map(str, OLDEST_TRITON))}, which PyTorch 2.11 brings"
        )
    if os.environ.get("CC") is None and shutil.which("gcc") is None and shutil.which("clang") is None:
        return "triton finds no C compiler to call the driver by: install gcc, or name one in CC"
    scheme = sysconfig.get_default_scheme()
    header = Path(sysconfig.get_paths("posix_prefix" if scheme == "posix_local" else scheme)["include"], "Python.h")
    if not header.is_file():
        return f"triton needs {header}, the headers of Python: install python3-dev or the like"
    return None


# --- image decoders ---------------------------------------------------------------------------------------------------

log = logging.getLogger(__name__)

#: The descriptor that libraries in C write to.
_STDERR = 2


def separate_stderr() -> None:
    """Duplicate the descriptor of ``sys.stderr``, so that :func:`decoder_messages` can redirect that of C libraries."""
    with suppress(OSError, AttributeError):  # it is closed
        encoding = sys.stderr.encoding
        sys.stderr = open(os.dup(_STDERR), "w", buffering=1, encoding=encoding, errors="backslashreplace")


class _Kept:
    """Text written to the descriptor while any thread decodes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = 0
        self._failed = False  # a decoding since the first of the threads began
        self._file: IO[bytes] | None = None  # made when first diverted
        self._place: int | None = None  # a descriptor that leads where the one led that is diverted; None: none is

    def begin(self) -> None:
        """Count a thread; the first one diverts the descriptor."""
        with self._lock:
            self._threads += 1
            if self._threads == 1 and _is_separate():
                self._failed = False
                self._file = self._file or tempfile.TemporaryFile()
                self._place = os.dup(_STDERR)
                os.dup2(self._file.fileno(), _STDERR)

    def end(self, failed: bool) -> str:
        """The first line of what was written; empty where a decoding failed, whose error says what is wrong."""
        with self._lock:
            self._threads -= 1
            self._failed |= failed
            if self._threads or self._place is None or self._file is None:
                return ""
            os.dup2(self._place, _STDERR)
            os.close(self._place)
            self._place = None
            self._file.seek(0)
            message = self._file.read().decode(errors="replace").strip()
            self._file.seek(0)
            self._file.truncate()
            return message.splitlines()[0] if message and not self._failed else ""


_KEPT = _Kept()


@contextmanager
def decoder_messages() -> Iterator[None]:
    """Keep what decoders write within, in any number of threads, off the terminal.

    An error says what is wrong with the file; without one, the first line becomes a warning.
    """
    _KEPT.begin()
    failed = True
    try:
        yield
        failed = False
    finally:
        if message := _KEPT.end(failed):
            log.warning("an image is read that may be damaged; its decoder says: %s", message)


def _is_separate() -> bool:
    """True if Python's standard error has another descriptor than the one that libraries in C write to."""
    with suppress(OSError, AttributeError, UnsupportedOperation, ValueError):
        return sys.stderr.fileno() != _STDERR
    return False
