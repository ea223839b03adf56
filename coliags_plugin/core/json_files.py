"""Reading JSON of unknown origin."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from coliags_plugin.core.errors import InputError


def read_json(path: Path, expected: str, do: str = "") -> Any:
    """The value of a JSON file in UTF-8, with or without a byte order mark.

    Args:
        path: The file.
        expected: What it should be, for messages.
        do: What the user can do about it.

    Raises:
        InputError: The file cannot be read, is not JSON, is nested too deeply, or has a number of thousands of digits.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}", expected, do) from error
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {error}", expected, do) from error


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: It is not JSON, is nested too deeply, or has a number of thousands of digits.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
