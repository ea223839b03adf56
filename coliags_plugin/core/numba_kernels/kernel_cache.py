"""Cache of compiled kernels on disk, by classes that numba keeps private."""

from __future__ import annotations

import hashlib
import logging
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

from numba.core.caching import FunctionCache

if TYPE_CHECKING:
    from numba.core.base import BaseContext
    from numba.core.codegen import Codegen
    from numba.core.compiler import CompileResult
    from numba.core.typing import Signature

_logger = logging.getLogger(__name__)
#: Announcements made: that kernels are kept (True), or cannot be (False).
_announced: set[bool] = set()
#: What a cache may raise when its folder is full, unreadable or holds damaged files.
_CACHE_ERRORS = (OSError, EOFError, pickle.PickleError, ValueError, AttributeError, ImportError, IndexError, TypeError)


def keep(dispatcher: Any, function: Callable[..., object]) -> None:
    """Cache what numba's dispatcher of a function compiles."""
    try:
        dispatcher._cache = KernelCache(function)
    except RuntimeError:  # numba: no folder to keep it in
        _announce(False, "nowhere to keep them: no folder for numba's cache can be written, set NUMBA_CACHE_DIR to one")


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
