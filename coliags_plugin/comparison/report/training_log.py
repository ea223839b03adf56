"""Reading of a run's training log."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import parse_json
from coliags_plugin.core.text_files import text_lines

_COLUMNS = ("step", "loss", "psnr", "seconds")


def read_training_log(run: Path) -> dict[str, Float[np.ndarray, "L"]]:
    """The logged steps of a run by column: step, loss, psnr, and seconds since training began.

    NaN where a line lacks the column; without the columns that no line has; empty where there is no log.
    """
    path = run / "metrics.jsonl"
    if not path.is_file():
        return {}
    rows = [_row(path, number, line) for number, line in text_lines(path, "the training log") if line.strip()]
    table = {name: np.array([_number(values.get(name)) for values in rows], dtype=np.float64) for name in _COLUMNS}
    return {name: values for name, values in table.items() if np.isfinite(values).any()}


def _row(path: Path, number: int, line: str) -> dict[str, Any]:
    try:
        values = parse_json(line)
    except ValueError as error:
        raise InputError(f"{path}, line {number} is not JSON: {error}", "one JSON object per line") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}, line {number} holds a {type(values).__name__}", "one JSON object per line")
    return values


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    return float(value) if math.isfinite(value) else math.nan
