"""``camera.json``, which describes a pinhole, pixel centres at integers (docs/layouts/c3vd.md 3)."""

from __future__ import annotations

import math
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.json_files import read_json


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics of a ``camera.json``.

    Raises:
        InputError: It is not JSON, or keys are missing, or their values are not sizes and focal lengths.
    """
    data = read_json(path, "a JSON object")
    keys = ("fx", "fy", "cx", "cy", "w", "h")
    if not isinstance(data, dict) or any(key not in data for key in keys):
        missing = [key for key in keys if not isinstance(data, dict) or key not in data]
        raise InputError(
            f"{path} has no {', '.join(missing)}",
            "fx, fy, cx, cy in pixels (centres at integers) and the image's w, h",
            "Add them",
        )
    values = [data[key] for key in keys]
    numbers = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v)]
    if len(numbers) < len(keys) or min(numbers[0], numbers[1], numbers[4], numbers[5]) <= 0:
        raise InputError(f"{path}: {dict(zip(keys, values, strict=True))}", "numbers, focal lengths and sizes above 0")
    fx, fy, cx, cy, width, height = numbers
    if width != int(width) or height != int(height):
        raise InputError(f"{path}: w = {width}, h = {height}", "whole pixels")
    return Intrinsics(float(fx), float(fy), cx + 0.5, cy + 0.5, int(width), int(height))


def write_camera_json(path: Path, intrinsics: Intrinsics, **more: float) -> None:
    """Write a ``camera.json``.

    Args:
        path: Where to.
        intrinsics: Of all images.
        more: ``w`` and ``h``, the image size in pixels, and other values of a format, in this order.
    """
    k = intrinsics
    write_json(path, {"fx": k.fx, "fy": k.fy, "cx": k.cx - 0.5, "cy": k.cy - 0.5, **more})
