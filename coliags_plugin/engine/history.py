"""Reading of training logs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError


def read_history(path: Path) -> dict[str, Float[np.ndarray, "T"]]:
    """Columns of a training log over its T rows.

    Those of a row's parts have dotted names (``terms.l1``). A last line that a kill cut short does not count.

    Args:
        path: The log, ``metrics.jsonl`` of a run.

    Returns:
        Numbers by column, float64; NaN where a row has none. Without a log there are no columns. [T] each

    Raises:
        InputError: The log cannot be read, or a line of it is no JSON object.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}", "the training log") from error
    whole = text[: text.rfind("\n") + 1]
    rows = [_numbers(_row(line, path, number)) for number, line in enumerate(whole.splitlines(), start=1) if line]
    columns = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, math.nan) for row in rows]) for name in columns}


def _row(line: str, path: Path, number: int) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError as error:
        raise InputError(f"{path}, line {number} is not JSON: {error}", "one JSON object per line") from error
    if not isinstance(row, dict):
        raise InputError(f"{path}, line {number} holds a {type(row).__name__}", "one JSON object per line")
    return row


def _numbers(row: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Numbers of a row by their dotted names; what is none is left out."""
    found: dict[str, float] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            found |= _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            found[prefix + name] = float(value)
    return found
