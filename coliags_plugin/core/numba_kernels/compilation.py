"""Compilation of the kernels, and of the functions they call."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import numba
import numpy.typing as npt

#: An array of a kernel; the kernel says of which type and shape.
Array: TypeAlias = npt.NDArray[Any]

#: Releases of numba whose private classes, in ``kernel_cache``, the tests ran with. With others nothing is kept on disk.
TESTED = ("0.61", "0.62", "0.63", "0.64", "0.65", "0.66", "0.67", "0.68")

_Function = TypeVar("_Function", bound=Callable[..., object])

_logger = logging.getLogger(__name__)
_OPTIONS = {"nogil": True, "error_model": "numpy", "boundscheck": False, "no_cfunc_wrapper": True}
_is_tested = ".".join(numba.__version__.split(".")[:2]) in TESTED
if not _is_tested:
    _logger.warning(
        "numba %s is none of the tested releases, %s to %s: its kernels are compiled anew by every process",
        numba.__version__,
        TESTED[0],
        TESTED[-1],
    )


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
    if _is_tested:
        from coliags_plugin.core.numba_kernels.kernel_cache import keep

        keep(dispatcher, function)
    return dispatcher  # type: ignore[no-any-return]
