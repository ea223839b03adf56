"""COLMAP made silent while it works; what it would say is in its results."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

#: glog's level above which only what ends the process is told.
_FATAL = 3


@contextmanager
def quiet_colmap(seed: int) -> Iterator[None]:
    """COLMAP without its log, its random numbers begun anew.

    Args:
        seed: Of COLMAP's own generator, which is the only one it has.
    """
    import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = _FATAL
    pycolmap.set_random_seed(seed)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
