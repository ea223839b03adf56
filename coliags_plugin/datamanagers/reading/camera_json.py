"""``camera.json``, which describes a pinhole, pixel centres at integers (docs/layouts/c3vd.md 3)."""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import image_size, read_json, read_number


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics of a ``camera.json``."""
    data = read_json(path, "a JSON object")
    keys = ("fx", "fy", "cx", "cy", "w", "h")
    if not isinstance(data, dict) or any(key not in data for key in keys):
        missing = [key for key in keys if not isinstance(data, dict) or key not in data]
        raise InputError(
            f"{path} has no {', '.join(missing)}",
            "fx, fy, cx, cy in pixels (centres at integers) and the image's w, h",
            "Add them",
        )
    fx, fy = (read_number(data, key, path, "a number above 0", above=0.0) for key in ("fx", "fy"))
    cx, cy = (read_number(data, key, path) for key in ("cx", "cy"))
    return Intrinsics(fx, fy, cx + 0.5, cy + 0.5, *image_size(data, path))


def write_camera_json(path: Path, intrinsics: Intrinsics, **more: float) -> None:
    """Write a ``camera.json``; ``more`` are ``w`` and ``h``, pixels, and other values of a format, in this order."""
    k = intrinsics
    write_json(path, {"fx": k.fx, "fy": k.fy, "cx": k.cx - 0.5, "cy": k.cy - 0.5, **more})
