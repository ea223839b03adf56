"""Numbers, durations and sizes as people read them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

Direction = Literal["higher", "lower"]

#: Stands for a missing value.
DASH = "\N{EN DASH}"
_SIGNIFICANT = 3
_MOST_DECIMALS = 4
_LONGEST_LIST = 6


def duration(seconds: float) -> str:
    """Duration in at most two units: ``4.2 s``, ``2 min 05 s``, ``3 h 20 min``."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02d} min"


def file_size(size: float) -> str:
    """Size in bytes as text: ``120 MB``, ``3.4 GB``."""
    return f"{size / 1e6:.0f} MB" if size < 1e9 else f"{size / 1e9:.1f} GB"


def area_text(area: float, metric: bool) -> str:
    """An area in mm^2 as ``20.5 cm²``, or one of unknown unit as ``2,050 square units``."""
    return f"{area / 100.0:.1f} cm²" if metric else f"{area:,.0f} square units"


def counted(number: int, noun: str) -> str:
    """A number with its noun: ``1 frame``, ``8 frames``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def plain(value: Any) -> str:
    """A JSON value as text: numbers to six digits, long lists abbreviated to their ends, nothing for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return f"{len(value)} entries"
    if isinstance(value, (list, tuple)):
        words = [plain(entry) for entry in value]
        if len(words) > _LONGEST_LIST:
            return f"{words[0]}, {words[1]}, …, {words[-1]} ({len(words)})"
        return ", ".join(words)
    return f"{value + 0.0:.6g}" if isinstance(value, float) else str(value)


def number_text(value: float, decimals: int) -> str:
    """A number with fixed decimals, never a negative zero."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def short_number(value: float | None, factor: float = 1.0, sign: str = "") -> str | None:
    """A number times ``factor`` with three significant digits; None for None. ``sign`` is that of a format."""
    return None if value is None else f"{value * factor:{sign}.3g}"


def column_decimals(unit: str, values: Iterable[float | None]) -> int:
    """Decimals of every value of a column: 2 for dB, 4 for plain numbers, else 3 digits of the smallest, at most 4."""
    if unit == "dB":
        return 2
    if unit in ("", "1"):
        return 4
    sizes = [abs(value) for value in values if value]
    if not sizes:
        return 2
    return min(max(_SIGNIFICANT - 1 - math.floor(math.log10(min(sizes))), 0), _MOST_DECIMALS)


def unit_text(unit: str) -> str:
    """Unit with typographic exponents: ``mm^2`` as mm²."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def ranks_of(keys: Sequence[float | None], direction: Direction | None) -> list[int | None]:
    """Rank of each value from 1 on; equal values share a rank and the next one is skipped.

    None where a value is unavailable, and everywhere with fewer than two values or without a direction. Give numbers as
    printed, so that what looks alike shares a rank.
    """
    sign = -1.0 if direction == "higher" else 1.0
    signed = [None if key is None else sign * key for key in keys]
    known = [key for key in signed if key is not None]
    if direction is None or len(known) < 2:
        return [None] * len(signed)
    return [None if key is None else 1 + sum(other < key for other in known) for key in signed]


def sentence(text: str) -> str:
    """A text that ends with a full stop."""
    return text if text.endswith((".", "!", "?")) else f"{text}."
