"""Compilation and on-disk caching of the kernels."""

from __future__ import annotations

import hashlib
import logging
import pickle
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numba
import numpy.typing as npt
from numba.core import types
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Flags, compile_extra
from numba.core.registry import CPUDispatcher

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
#: Announcements made: that kernels are kept (True), or cannot be (False).
_announced: set[bool] = set()
_OPTIONS = {"nogil": True, "error_model": "numpy", "boundscheck": False}


def inline(function: _Function) -> _Function:
    """Compile a function that is inlined into its callers."""
    return _Part(function, targetoptions={"nopython": True, "forceinline": True, **_OPTIONS})  # type: ignore[return-value]


def part(function: _Function) -> _Function:
    """Compile a function that kernels call, on one thread."""
    return _Part(function, targetoptions={"nopython": True, **_OPTIONS})  # type: ignore[return-value]


def kernel(function: _Function) -> _Function:
    """Compile a function that Python calls, on several threads by ``threads.Crew``; cached on disk.

    numba's own parallel loops are not used. They wait for every thread at their end, also for those that the system
    has not let run yet, which on a shared machine costs more than the loop; two of them at once, or one in a forked
    process, abort the interpreter; and numba moves what stands behind such a loop in front of it when the loop's
    writes are out of its sight, in a function called.
    """
    dispatcher = numba.njit(function, no_cfunc_wrapper=True, **_OPTIONS)
    try:
        dispatcher._cache = _KernelCache(function)
    except RuntimeError:  # numba: no folder to keep it in
        _announce(False, "nowhere to keep them: no folder for numba's cache can be written, set NUMBA_CACHE_DIR to one")
    return dispatcher  # type: ignore[no-any-return]


class _Part(CPUDispatcher):  # type: ignore[misc]
    """A function that only kernels call; its LLVM code is optimised and translated within each of them alone.

    numba compiles each function completely, with wrappers for calls from Python and C and once for each constant among its
    arguments, before it links it into its callers and optimises and translates it again there. That doubles the time.
    """

    def compile(self, sig: Sequence[types.Type]) -> None:
        arguments = tuple(types.unliteral(kind) for kind in sig)
        if arguments in self.overloads:
            return
        flags = Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        library = _PartLibrary(self.targetctx.codegen(), self.py_func.__qualname__)
        compiled = compile_extra(self.typingctx, self.targetctx, self.py_func, arguments, None, flags, {}, library)
        self.targetctx.insert_user_function(compiled.fndesc, compiled.fndesc, [library])
        self.overloads[arguments] = compiled

    def get_overload(self, sig: Sequence[types.Type]) -> object:
        return self.overloads[tuple(sig)].fndesc

    def _compile_for_args(self, *arguments: object, **named: object) -> None:
        raise TypeError(f"{self.py_func.__qualname__} is a part of kernels and cannot be called from Python")


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code of a part and of all that it calls, not optimised."""

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class _KernelCache(FunctionCache):
    """numba's on-disk cache with three changes.

    - A kernel is invalidated when any file of its folder, of the one above or of this one changes, as it may have
      constants from there (numba checks its own file only).
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
            _announce(True, f"kept in {self.cache_path} and the like")
        return found

    def save_overload(self, sig: Signature, data: CompileResult) -> None:
        try:
            super().save_overload(sig, data)
        except _CACHE_ERRORS as error:
            _logger.warning("kernel cache in %s cannot be written (%s)", self.cache_path, error)

    def _index_key(self, sig: Signature, codegen: Codegen) -> tuple[object, ...]:
        return (*super()._index_key(sig, codegen), _fingerprint(Path(self._py_func.__code__.co_filename).parent))


def _announce(kept: bool, where: str) -> None:
    """Log once that kernels are being compiled, and once that they cannot be kept."""
    if kept not in _announced:
        _announced.add(kept)
        _logger.info("compiling kernels for this machine, about ten seconds, once (%s)", where)


@cache
def _fingerprint(folder: Path) -> str:
    """Hash of the sources in a folder of kernels, in the one above and in this one."""
    digest = hashlib.sha256()
    for path in sorted(
        {path for place in (Path(__file__).parent, folder, folder.parent) for path in place.glob("*.py")}
    ):
        digest.update(path.read_bytes())
    return digest.hexdigest()
