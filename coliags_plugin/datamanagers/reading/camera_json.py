"""``camera.json``, which describes a pinhole (docs/layouts/c3vd.md 3)."""

from __future__ import annotations

import json
import math
from pathlib import Path

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.lenses.models import Pinhole


def read_intrinsics(path: Path) -> tuple[Pinhole, int, int]:
    """Intrinsics (pixel centres at integers), width and height from a ``camera.json``.

    Raises:
        InputError: It is not JSON, or keys are missing, or their values are not sizes and focal lengths.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}", "a JSON object") from error
    keys = ("fx", "fy", "cx", "cy", "w", "h")
    if not isinstance(data, dict) or any(key not in data for key in keys):
        missing = [key for key in keys if not isinstance(data, dict) or key not in data]
        raise InputError(
            f"{path} has no {', '.join(missing)}",
            "fx, fy, cx, cy in pixels (centres at integers) and the picture's w, h",
            "Add them",
        )
    values = [data[key] for key in keys]
    numbers = [v for v in values if isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v)]
    if len(numbers) < len(keys) or min(numbers[0], numbers[1], numbers[4], numbers[5]) <= 0:
        raise InputError(f"{path}: {dict(zip(keys, values, strict=True))}", "numbers, focal lengths and sizes above 0")
    fx, fy, cx, cy, width, height = numbers
    if width != int(width) or height != int(height):
        raise InputError(f"{path}: w = {width}, h = {height}", "whole pixels")
    return Pinhole(float(fx), float(fy), float(cx), float(cy)), int(width), int(height)


def write_camera_json(path: Path, pinhole: Pinhole, **more: float) -> None:
    """Write a ``camera.json``.

    Args:
        path: Where to.
        pinhole: Intrinsics, pixels, centres at integers.
        more: ``w`` and ``h``, the picture's size in pixels, and whatever else a format keeps there, in this order.
    """
    write_json(path, {**pinhole._asdict(), **more})
