"""Training logs as columns of numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, Float[np.ndarray, "T"]]:
    """Columns of the T rows of a training log.

    Numbers in a part of a row have dotted names (``terms.l1``); what is no number is left out.

    Args:
        rows: As :meth:`coliags_plugin.engine.run_folder.RunFolder.log_rows` reads them. [T]

    Returns:
        Numbers by name, NaN where a row has none. [T] each
    """
    found = [_numbers(row) for row in rows]
    names = dict.fromkeys(name for row in found for name in row)
    return {name: np.array([row.get(name, math.nan) for row in found]) for name in names}


def _numbers(row: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    found: dict[str, float] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            found |= _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            found[prefix + name] = float(value)
    return found
