"""Numbers in JSON files of unknown origin."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from coliags_plugin.core.errors import InputError


def read_number(
    values: Mapping[str, Any],
    key: str,
    where: object,
    expected: str = "a finite number",
    above: float = -math.inf,
    below: float = math.inf,
) -> float:
    """A finite number.

    Args:
        values: Content of the file.
        key: Its key.
        where: The file, and the place in it, for the error.
        expected: What the number should be, for the error.
        above: It must be larger.
        below: It must be smaller.

    Raises:
        InputError: It is missing, not a finite number, or out of range.
    """
    value = values.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        if above < value < below:
            return float(value)
    raise InputError(f"{where}: {key} is {value!r}", expected)


def image_size(values: Mapping[str, Any], where: object) -> tuple[int, int]:
    """Width and height of images, pixels, of the keys ``w`` and ``h``.

    Raises:
        InputError: They are not whole numbers above 0.
    """
    width, height = (read_number(values, key, where, "whole pixels, above 0", above=0.0) for key in ("w", "h"))
    if width != int(width) or height != int(height):
        raise InputError(f"{where}: w = {width}, h = {height}", "whole pixels")
    return int(width), int(height)
