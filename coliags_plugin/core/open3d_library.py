"""Import of open3d."""

from __future__ import annotations

import os
from typing import Any

from coliags_plugin.core.errors import InputError


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
