"""COLMAP and open3d, silent and deterministic."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from coliags_plugin.core.open3d_library import import_open3d


@contextmanager
def deterministic_open3d() -> Iterator[Any]:
    """open3d, silent and on one thread: with several the order of summation varies, and poses differ by 1e-6.

    open3d before 0.20 cannot limit its threads.
    """
    library = import_open3d("registers frames and optimises the pose graph")
    can_limit = hasattr(library.utility, "set_max_threads")
    threads = library.utility.get_max_threads() if can_limit else 0
    if can_limit:
        library.utility.set_max_threads(1)
    try:
        with library.utility.VerbosityContextManager(library.utility.VerbosityLevel.Error):
            yield library
    finally:
        if can_limit:
            library.utility.set_max_threads(threads)


#: glog's level FATAL.
_FATAL = 3


@contextmanager
def quiet_colmap(seed: int) -> Iterator[None]:
    """Silence COLMAP's log and seed its global random generator."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _FATAL
    pycolmap.set_random_seed(seed)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
