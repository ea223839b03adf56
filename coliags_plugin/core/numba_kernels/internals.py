"""Parts of kernels without code of their own, and a cache of kernels, from private classes of numba.

Private classes change without notice: ``compilation`` uses this module with the releases of numba it is tested with.
"""

from __future__ import annotations

import hashlib
import logging
import pickle
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING

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

_logger = logging.getLogger(__name__)
#: What a cache may raise when its folder is full, unreadable or holds damaged files.
_CACHE_ERRORS = (OSError, EOFError, pickle.PickleError, ValueError, AttributeError, ImportError, IndexError, TypeError)


class Part(CPUDispatcher):  # type: ignore[misc]
    """A function that only kernels call; its LLVM code is optimised and translated within each of them alone.

    numba compiles each function completely, with wrappers for calls from Python and C and once for each constant among its
    arguments, before it links it into its callers and optimises and translates it again there. That doubles the time.
    """

    def compile(self, sig: Sequence[types.Type]) -> None:
        """Type the function for a signature, and keep its LLVM code."""
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
        """Descriptor of the function for a signature, for its callers."""
        return self.overloads[tuple(sig)].fndesc

    def _compile_for_args(self, *arguments: object, **named: object) -> None:
        raise TypeError(f"{self.py_func.__qualname__} is a part of kernels and cannot be called from Python")


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code of a part and of all that it calls, not optimised."""

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class KernelCache(FunctionCache):
    """numba's on-disk cache with three changes.

    - A kernel is invalidated when any file of its folder, of the one above or of this one changes, as it may have
      constants from there (numba checks its own file only). Kernels that a factory makes are told apart by the names of
      the functions they enclose (numba pickles these, which differs from process to process).
    - A cache that cannot be read or written causes a compilation, never an error.
    - ``announce`` is called with its folder before a compilation.
    """

    def __init__(self, function: Callable[..., object], announce: Callable[[str], None]) -> None:
        super().__init__(function)
        self._announce = announce

    def load_overload(self, sig: Signature, target_context: BaseContext) -> CompileResult | None:
        """The compiled kernel of a signature; None where it has to be compiled."""
        try:
            compiled = super().load_overload(sig, target_context)
        except _CACHE_ERRORS as error:
            _logger.warning("kernel cache in %s cannot be read (%s)", self.cache_path, error)
            compiled = None
        if compiled is None:
            self._announce(self.cache_path)
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
