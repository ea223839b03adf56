"""Libraries that may be missing: open3d, which is slow to import, and triton."""

from __future__ import annotations

import os
import shutil
import sysconfig
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from coliags_plugin.core.errors import InputError

#: The oldest release of triton that all kernels compile with; PyTorch 2.11 brings it.
OLDEST_TRITON = (3, 6)


def import_open3d(purpose: str) -> Any:
    """open3d, which takes a second to import; in a notebook without its server of 3D views, which prints and listens.

    The purpose, what it does, is for the message where it cannot be imported.
    """
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"open3d cannot be imported ({error})",
            f"open3d, which {purpose}",
            "Install it with `pip install open3d`; on Debian and Ubuntu it also needs the package libusb-1.0-0",
        ) from error
    return open3d


@cache
def what_triton_lacks() -> str | None:
    """Why triton cannot launch kernels on this machine, and what to do; None where it can.

    At first use it compiles the C code that calls the driver.
    """
    if find_spec("triton") is None:
        return "triton is not installed; PyTorch for CUDA on Linux brings it"
    import triton

    if tuple(int(part) for part in triton.__version__.split(".")[:2]) < OLDEST_TRITON:
        return (
            f"triton {triton.__version__} is older than {'.'.join(map(str, OLDEST_TRITON))}, which PyTorch 2.11 brings"
        )
    if os.environ.get("CC") is None and shutil.which("gcc") is None and shutil.which("clang") is None:
        return "triton finds no C compiler to call the driver by: install gcc, or name one in CC"
    scheme = sysconfig.get_default_scheme()
    header = Path(sysconfig.get_paths("posix_prefix" if scheme == "posix_local" else scheme)["include"], "Python.h")
    if not header.is_file():
        return f"triton needs {header}, the headers of Python: install python3-dev or the like"
    return None
