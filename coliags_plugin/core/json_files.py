"""Reading JSON of unknown origin."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.text_files import whole_text

#: Plain values by name, as in a JSON file.
JsonObject: TypeAlias = dict[str, Any]


def read_json(path: Path, expected: str, do: str = "", finite: bool = False) -> Any:
    """The value of a JSON file in UTF-8, with or without a byte order mark; ``finite`` as in :func:`parse_json`."""
    try:
        text = json_text(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {error}", expected, do) from error
    try:
        return parse_json(text, finite)
    except json.JSONDecodeError as error:
        line = (*text.splitlines(), "")[error.lineno - 1].strip()
        problem = f"{path} is not JSON: {error.msg} in line {error.lineno}, column {error.colno}: '{line[:60]}'"
        hint = "JSON has neither comments nor a comma behind the last value" if error.pos else ""
        raise InputError(problem, expected, do or hint) from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {error}", expected, do) from error


def json_text(path: Path) -> str:
    """The text of a JSON file; ValueError if it is too large or not UTF-8."""
    return whole_text(path, bounds.JSON_BYTES)


def parse_json(text: str | bytes, finite: bool = False) -> Any:
    """The value of a JSON text; ``finite`` refuses infinity and NaN, which cannot be written again.

    What is not JSON, is nested too deeply or has a number of thousands of digits is a ValueError.
    """
    try:
        return json.loads(text, **(_FINITE if finite else {}))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text)


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")


_FINITE: dict[str, Any] = {"parse_float": _finite, "parse_constant": _refuse}


def read_number(
    values: Mapping[str, Any],
    key: str,
    where: object,
    expected: str = "a finite number",
    above: float = -math.inf,
    below: float = math.inf,
) -> float:
    """The finite number of a JSON object under a key, strictly between two others; ``where`` is named in errors."""
    value = values.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        if above < value < below:
            return float(value)
    raise InputError(f"{where}: {key} is {value!r}", expected)


def image_size(values: Mapping[str, Any], where: object) -> tuple[int, int]:
    """Width and height of images, whole pixels above 0, of the keys ``w`` and ``h``."""
    width, height = (read_number(values, key, where, "whole pixels, above 0", above=0.0) for key in ("w", "h"))
    if width != int(width) or height != int(height):
        raise InputError(f"{where}: w = {width}, h = {height}", "whole pixels")
    return int(width), int(height)


def scalars(row: JsonObject) -> dict[str, float]:
    """Numbers of a row of the training log but its step, those of the loss terms as ``terms/NAME``."""
    flat = {name: value for name, value in row.items() if name != "step"}
    terms = flat.pop("terms", None)
    flat |= {f"terms/{name}": value for name, value in terms.items()} if isinstance(terms, dict) else {}
    return {
        name: float(value)
        for name, value in flat.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }
