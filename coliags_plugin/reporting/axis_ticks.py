"""Tick positions and labels for axes and colour bars."""

from __future__ import annotations

import math

_STEPS = (1.0, 2.0, 5.0, 10.0)
#: Relative tolerance, so that rounding errors do not round 0.2 up to 0.5.
_SLACK = 1e-9


def round_up(value: float) -> float:
    """The smallest 1, 2 or 5 times a power of ten that is not below ``value``, which is positive and finite."""
    exponent = math.floor(math.log10(value))
    power = 10.0**exponent if exponent >= 0 else 1.0 / 10.0**-exponent
    for step in _STEPS:
        if value <= step * power * (1.0 + _SLACK):
            return step * power
    return 10.0 * power


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
