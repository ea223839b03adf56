"""Compilation and on-disk caching of the kernels."""

from __future__ import annotations

import hashlib
import logging
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numba
import numpy.typing as npt
from numba.core.caching import FunctionCache

if TYPE_CHECKING:
    from numba.core.base import BaseContext
    from numba.core.codegen import Codegen
    from numba.core.compiler import CompileResult
    from numba.core.typing import Signature

#: An array of a kernel; the kernel says of which type and shape.
Array: TypeAlias = npt.NDArray[Any]

_Function = TypeVar("_Function", bound=Callable[..., object])

_logger = logging.getLogger(__name__)
#: What a cache may raise when its folder is full, unreadable or holds damaged files.
_CACHE_ERRORS = (OSError, EOFError, pickle.PickleError, ValueError, AttributeError, ImportError, IndexError, TypeError)
_OPTIONS = {"nogil": True, "error_model": "numpy", "boundscheck": False}


def inline(function: _Function) -> _Function:
    """Compile a function that is inlined into its callers."""
    return numba.njit(function, forceinline=True, **_OPTIONS)  # type: ignore[no-any-return]


def part(function: _Function) -> _Function:
    """Compile a function that kernels call, on one thread."""
    return numba.njit(function, **_OPTIONS)  # type: ignore[no-any-return]


def kernel(function: _Function) -> _Function:
    """Compile a function that Python calls, on several threads by ``threads.Crew``; cached on disk.

    numba's own parallel loops are not used. They wait for every thread at their end, also for those that the system
    has not let run yet, which on a shared machine costs more than the loop; two of them at once, or one in a forked
    process, abort the interpreter; and numba moves what stands behind such a loop in front of it when the loop's
    writes are out of its sight, in a function called.
    """
    dispatcher = numba.njit(function, **_OPTIONS)
    try:
        dispatcher._cache = _KernelCache(function)
    except RuntimeError:  # numba: no folder to keep it in
        _announce("nowhere to keep them: no folder for numba's cache can be written, set NUMBA_CACHE_DIR to one")
    return dispatcher  # type: ignore[no-any-return]


class _KernelCache(FunctionCache):
    """numba's on-disk cache with three changes.

    - A kernel is invalidated when any file of its folder or of this one changes (numba checks its own file only).
    - A cache that cannot be read or written causes a compilation, never an error.
    - A message is logged before compilation.
    """

    def load_overload(self, sig: Signature, target_context: BaseContext) -> CompileResult | None:
        try:
            found = super().load_overload(sig, target_context)
        except _CACHE_ERRORS as error:
            _logger.warning("kernel cache in %s cannot be read (%s)", self.cache_path, error)
            found = None
        if found is None:
            _announce(f"kept in {self.cache_path}")
        return found

    def save_overload(self, sig: Signature, data: CompileResult) -> None:
        try:
            super().save_overload(sig, data)
        except _CACHE_ERRORS as error:
            _logger.warning("kernel cache in %s cannot be written (%s)", self.cache_path, error)

    def _index_key(self, sig: Signature, codegen: Codegen) -> tuple[object, ...]:
        return (*super()._index_key(sig, codegen), _fingerprint(Path(self._py_func.__code__.co_filename).parent))


@cache
def _announce(where: str) -> None:
    """Log once per cache location that kernels are being compiled."""
    _logger.info("compiling kernels for this machine, about half a minute, once (%s)", where)


@cache
def _fingerprint(folder: Path) -> str:
    """Hash of the sources of all kernels of a folder and of this one."""
    digest = hashlib.sha256()
    for path in sorted({*Path(__file__).parent.glob("*.py"), *folder.glob("*.py")}):
        digest.update(path.read_bytes())
    return digest.hexdigest()
