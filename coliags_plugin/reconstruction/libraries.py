"""COLMAP, silent and deterministic."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
