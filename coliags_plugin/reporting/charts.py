"""Geometry of line charts, which the template ``charts.html`` draws as SVG and the page's style sheet colours.

The SVG has CSS classes and no colours, so that a chart can be read on a light and on a dark page: ``.chart .frame``,
``.grid``, ``.tick``, ``.axis`` and, for each series style, ``.s0`` to ``.s7`` with a ``color`` that lines and markers
take. A ninth series takes the first colour again, dashed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from coliags_plugin.reporting.colormaps import ColorMap, color_table
from coliags_plugin.reporting.numbers import linear_ticks, log_ticks, tick_label

COLORS = 8

_STOPS = 16
#: Width of one character of an x tick label, view box units.
_LABEL_ROOM = 7.5


@dataclass(frozen=True)
class Series:
    """One line of a chart."""

    name: str  # label
    style: int  # colour index, the same for one method in every chart of a page
    x: Sequence[float]  # increasing
    #: same length; values that are not finite (or not positive on a logarithmic axis) interrupt the line
    y: Sequence[float]

    def points(self, log_y: bool) -> Iterator[tuple[float, float] | None]:
        """Points of the line; None where one cannot be drawn."""
        for x, y in zip(self.x, self.y, strict=True):
            yield (x, y) if math.isfinite(x) and math.isfinite(y) and (y > 0.0 or not log_y) else None


def style_classes(style: int) -> str:
    """CSS classes of a series style."""
    return f"s{style % COLORS}" + (f" dash{style // COLORS}" if style >= COLORS else "")


def color_stops(color_map: ColorMap) -> list[tuple[float, str]]:
    """Offsets, 0 to 1, and hexadecimal colours of a gradient."""
    table = color_table(color_map)
    return [(index / _STOPS, bytes(table[round(index / _STOPS * 255)]).hex()) for index in range(_STOPS + 1)]


class Axes:
    """Mapping from the values of series, which have points, to the coordinates of a view box.

    ``names`` are those of x = 0, 1, ... of a categorical axis.
    """

    width: ClassVar[int] = 600
    height: ClassVar[int] = 300
    left: ClassVar[int] = 68
    right: ClassVar[int] = 586
    top: ClassVar[int] = 12
    bottom: ClassVar[int] = 250

    def __init__(self, series: Sequence[Series], log_y: bool = False, names: Sequence[str] | None = None) -> None:
        self._log_y, self._names = log_y, names
        xs, ys = zip(*(point for line in series for point in line.points(log_y) if point), strict=True)
        self._x_limits = (min(xs), max(xs)) if names is None else (-0.5, len(names) - 0.5)
        if self._x_limits[0] == self._x_limits[1]:
            self._x_limits = self._x_limits[0] - 0.5, self._x_limits[1] + 0.5
        low, high = min(ys), max(ys)
        if log_y:
            # At least half a decade, so that there are tick labels.
            margin = max(1.1, math.sqrt(10.0**0.5 / min(high / low, 10.0**0.5)))
            self._y_limits = low / margin, high * margin
        else:
            margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.05
            self._y_limits = low - margin, high + margin

    def x(self, value: float) -> float:
        """Horizontal coordinate of a value."""
        low, high = self._x_limits
        return self.left + (value - low) / (high - low) * (self.right - self.left)

    def y(self, value: float) -> float:
        """Vertical coordinate of a value."""
        low, high = self._y_limits
        share = math.log(value / low) / math.log(high / low) if self._log_y else (value - low) / (high - low)
        return self.bottom - share * (self.bottom - self.top)

    @property
    def y_ticks(self) -> list[tuple[float, str]]:
        """Coordinates and labels of the y axis."""
        ticks = log_ticks(*self._y_limits) if self._log_y else linear_ticks(*self._y_limits)
        return [(self.y(tick), tick_label(tick)) for tick in ticks]

    @property
    def x_ticks(self) -> list[tuple[float, str]]:
        """Coordinates and labels of the x axis; of many names, some."""
        if (names := self._names) is None:
            return [(self.x(tick), tick_label(tick)) for tick in linear_ticks(*self._x_limits)]
        longest = max(map(len, names)) + 2
        room = max(1, int((self.right - self.left) / (longest * _LABEL_ROOM)))
        return [(self.x(index), names[index]) for index in range(0, len(names), math.ceil(len(names) / room))]

    def paths(self, line: Series) -> list[str]:
        """SVG paths of the uninterrupted segments of a line."""
        segments: list[list[str]] = [[]]
        for point in line.points(self._log_y):
            if point is None:
                segments.append([])
            else:
                segments[-1].append(f"{self.x(point[0]):.1f} {self.y(point[1]):.1f}")
        # A segment of one point is visible too: round caps draw a line of no length as a dot.
        return ["M" + "L".join(s if len(s) > 1 else s * 2) for s in segments if s]

    def markers(self, line: Series) -> list[tuple[float, float, str]]:
        """Coordinates and label of a marker at every point of a line."""
        return [
            (self.x(x), self.y(y), f"{line.name}, {self._names[int(x)] if self._names else tick_label(x)}: {y:.4g}")
            for x, y in filter(None, line.points(self._log_y))
        ]
