"""Numbers, durations and sizes as people read them, and tick positions of axes."""

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
_TICK_STEPS = (1.0, 2.0, 5.0, 10.0)
#: Relative tolerance of ticks, so that rounding errors do not round 0.2 up to 0.5.
_SLACK = 1e-9


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


def letters(index: int) -> str:
    """Letters that count: a to z, then aa, ab and so on, for the numbers from 0."""
    return (chr(ord("a") + index // 26 - 1) if index >= 26 else "") + chr(ord("a") + index % 26)


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


def short_number(value: float | None, factor: float = 1.0) -> str | None:
    """A number times ``factor`` with three significant digits; None for None."""
    return None if value is None else f"{value * factor:.3g}"


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
    numbers = [key for key in keys if key is not None]
    if direction is None or len(numbers) < 2:
        return [None] * len(keys)
    sign = -1.0 if direction == "higher" else 1.0
    return [None if key is None else 1 + sum(sign * other < sign * key for other in numbers) for key in keys]


def sentence(text: str) -> str:
    """A text that ends with a full stop."""
    return text if text.endswith((".", "!", "?")) else f"{text}."


def round_up(value: float) -> float:
    """The smallest 1, 2 or 5 times a power of ten that is not below ``value``, which is positive and finite."""
    exponent = math.floor(math.log10(value))
    power = 10.0**exponent if exponent >= 0 else 1.0 / 10.0**-exponent
    return next((step * power for step in _TICK_STEPS if value <= step * power * (1.0 + _SLACK)), 10.0 * power)


def linear_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """At most ``count + 1`` multiples of one 1-2-5 step inside [low, high], which is finite and not empty."""
    step = round_up((high - low) / count)
    first = math.ceil(low / step - _SLACK)
    last = math.floor(high / step + _SLACK)
    return [index * step for index in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """The 1-2-5 numbers inside [low, high], thinned to powers of ten over three decades and more."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    digits = (1.0,) if math.log10(high / low) >= 3.0 else (1.0, 2.0, 5.0)
    candidates = [digit * 10.0**exponent for exponent in exponents for digit in digits]
    return [tick for tick in candidates if low * (1.0 - _SLACK) <= tick <= high * (1.0 + _SLACK)]


def tick_label(value: float) -> str:
    """Shortest label of a tick, without an exponent between 0.0001 and 999 999."""
    text = f"{value:.6g}"
    return "0" if text == "-0" else text
