"""Context manager for deterministic open3d."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from coliags_plugin.core.errors import InputError


@contextmanager
def deterministic_open3d() -> Iterator[Any]:
    """open3d, silent and on one thread: with several the order of summation varies, and poses differ by 1e-6.

    open3d before 0.20 cannot limit its threads.

    Raises:
        InputError: open3d cannot be imported.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"open3d cannot be imported ({error})",
            "open3d, which registers frames and optimises the pose graph",
            "Install it with `pip install open3d`; on Debian and Ubuntu it also needs the package libusb-1.0-0",
        ) from error
    library: Any = open3d
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
