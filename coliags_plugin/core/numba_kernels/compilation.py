"""Compilation of the kernels, and of the functions they call, and the cache of kernels."""

from __future__ import annotations

import hashlib
import logging
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
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
#: Announcements made: that kernels are kept (True), or cannot be (False).
_announced: set[bool] = set()
_OPTIONS = {"nogil": True, "error_model": "numpy", "boundscheck": False, "no_cfunc_wrapper": True}
#: What a cache may raise when its folder is full, unreadable or holds damaged files.
_CACHE_ERRORS = (OSError, EOFError, pickle.PickleError, ValueError, AttributeError, ImportError, IndexError, TypeError)


def inline(function: _Function) -> _Function:
    """Compile a function that is inlined into its callers."""
    return numba.njit(function, no_cpython_wrapper=True, forceinline=True, **_OPTIONS)  # type: ignore[no-any-return]


def part(function: _Function) -> _Function:
    """Compile a function that kernels call, on one thread."""
    return numba.njit(function, no_cpython_wrapper=True, **_OPTIONS)  # type: ignore[no-any-return]


def kernel(function: _Function) -> _Function:
    """Compile a function that Python calls, on several threads by ``threads.Crew``; cached on disk.

    numba's own parallel loops are not used. They wait for every thread at their end, also for those that the system
    has not let run yet, which on a shared machine costs more than the loop; two of them at once, or one in a forked
    process, abort the interpreter; and numba moves what stands behind such a loop in front of it when the loop's
    writes are out of its sight, in a function called.
    """
    dispatcher = numba.njit(function, **_OPTIONS)
    try:
        dispatcher._cache = KernelCache(function)
    except RuntimeError:  # numba: no folder to keep it in
        _announce(False, "nowhere to keep them: no folder for numba's cache can be written, set NUMBA_CACHE_DIR to one")
    return dispatcher  # type: ignore[no-any-return]


def _announce(kept: bool, where: str) -> None:
    """Log once that kernels are being compiled, and once that they cannot be kept."""
    if kept not in _announced:
        _announced.add(kept)
        _logger.info("compiling kernels for this machine, about ten seconds, once (%s)", where)


class KernelCache(FunctionCache):
    """numba's on-disk cache, announced before a compilation, with two changes.

    - A kernel is invalidated when any file of its folder, of the one above or of this one changes, as it may have
      constants from there (numba checks its own file only). Kernels that a factory makes are told apart by the names of
      the functions they enclose (numba pickles these, which differs from process to process).
    - A cache that cannot be read or written causes a compilation, never an error.
    """

    def load_overload(self, sig: Signature, target_context: BaseContext) -> CompileResult | None:
        """The compiled kernel of a signature; None where it has to be compiled."""
        try:
            compiled = super().load_overload(sig, target_context)
        except _CACHE_ERRORS as error:
            _logger.warning("kernel cache in %s cannot be read (%s)", self.cache_path, error)
            compiled = None
        if compiled is None:
            _announce(True, f"kept in {self.cache_path} and the like")
        return compiled

    def save_overload(self, sig: Signature, data: CompileResult) -> None:
        """Keep a compiled kernel, if the folder can be written."""
        try:
            super().save_overload(sig, data)
        except _CACHE_ERRORS as error:
            _logger.warning("kernel cache in %s cannot be written (%s)", self.cache_path, error)

    def _index_key(self, sig: Signature, codegen: Codegen) -> tuple[object, ...]:
        folder = Path(self._py_func.__code__.co_filename).parent
        return sig, codegen.magic_tuple(), _identity(self._py_func), _fingerprint(folder)


def _identity(value: object) -> object:
    """Name of a function and the identities of what it encloses; other values as they are."""
    function = getattr(value, "py_func", value)
    if not isinstance(function, FunctionType):
        return value
    enclosed = tuple(_identity(cell.cell_contents) for cell in function.__closure__ or ())
    return function.__module__, function.__qualname__, enclosed


@cache
def _fingerprint(folder: Path) -> str:
    """Hash of the sources in a folder of kernels, in the one above and in this one."""
    digest = hashlib.sha256()
    for path in sorted(
        {path for place in (Path(__file__).parent, folder, folder.parent) for path in place.glob("*.py")}
    ):
        digest.update(path.read_bytes())
    return digest.hexdigest()
