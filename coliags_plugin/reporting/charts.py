"""Line charts and colour bars as inline SVG, styled by the page.

The SVG uses CSS classes and no colours, so a chart is readable on a light and on a dark page. The page defines
``.chart .frame``, ``.grid``, ``.tick``, ``.axis`` and, for each series style, ``.s0`` to ``.s7`` with a ``color``;
line and marker take the current colour. A ninth series takes the first colour again, dashed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from coliags_plugin.reporting.axis_ticks import linear_ticks, log_ticks, tick_label
from coliags_plugin.reporting.colormaps import ColorMap, color_table

COLORS = 8

_WIDTH, _HEIGHT = 600, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 68, 14, 12, 50
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


def style_classes(style: int) -> str:
    """CSS classes of a series style."""
    return f"s{style % COLORS}" + (f" dash{style // COLORS}" if style >= COLORS else "")


def line_chart(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    *,
    log_y: bool = False,
    x_names: Sequence[str] | None = None,
    markers: bool = False,
) -> str:
    """SVG line chart with labelled axes, or an empty string where no series has a point to draw.

    ``x_names`` are the names of x = 0, 1, ... of a categorical axis; ``markers`` draws a dot with a tooltip at every
    point.
    """
    points = [
        (x, y)
        for line in series
        for x, y in zip(line.x, line.y, strict=True)
        if math.isfinite(x) and _drawable(y, log_y)
    ]
    if not points:
        return ""
    axes = _Axes.around([x for x, _ in points], [y for _, y in points], log_y, x_names)
    caption = escape(f"{y_label} over {x_label}", quote=True)
    parts = [f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{caption}">']
    parts += axes.drawn(x_label, y_label)
    for line in series:
        parts.append(f'<g class="series {style_classes(line.style)}"><title>{escape(line.name)}</title>')
        parts += [f'<path class="line" d="{path}"/>' for path in axes.paths(line)]
        if markers:
            parts += [
                f'<circle class="dot" cx="{axes.x(x):.1f}" cy="{axes.y(y):.1f}" r="3"><title>{escape(line.name)}, '
                f"{escape(x_names[int(x)] if x_names else tick_label(x))}: {y:.4g}</title></circle>"
                for x, y in zip(line.x, line.y, strict=True)
                if _drawable(y, log_y)
            ]
        parts.append("</g>")
    parts.append("</svg>")
    return "".join(parts)


def color_bar_svg(limits: tuple[float, float], unit: str, color_map: ColorMap, label: str, name: str) -> str:
    """SVG colour bar of ``label`` with ticks and unit; ``name``, unique on the page, identifies its gradient."""
    low, high = limits
    left, width, top, height = 14, 312, 20, 12
    table = color_table(color_map)
    stops = "".join(
        f'<stop offset="{index / _STOPS:.4f}" stop-color="#{bytes(table[round(index / _STOPS * 255)]).hex()}"/>'
        for index in range(_STOPS + 1)
    )
    parts = [
        f'<svg class="bar" viewBox="0 0 340 50" role="img" aria-label="{escape(f"{label}, {unit}", quote=True)}">',
        f'<defs><linearGradient id="{escape(name, quote=True)}">{stops}</linearGradient></defs>',
        f'<text class="axis" x="{left}" y="13">{escape(label)} <tspan class="unit">[{escape(unit)}]</tspan></text>',
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="url(#{escape(name, quote=True)})"/>',
    ]
    for tick in linear_ticks(low, high):
        x = left + (tick - low) / (high - low) * width
        parts.append(f'<path class="frame" d="M{x:.1f} {top + height}v4"/>')
        parts.append(
            f'<text class="tick" x="{x:.1f}" y="{top + height + 16}" text-anchor="middle">{tick_label(tick)}</text>'
        )
    return "".join([*parts, "</svg>"])


def _drawable(value: float, log_y: bool) -> bool:
    return math.isfinite(value) and (value > 0.0 or not log_y)


@dataclass(frozen=True)
class _Axes:
    """Mapping from values to view box coordinates, and the axes' SVG."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    log_y: bool
    x_names: Sequence[str] | None

    @classmethod
    def around(cls, xs: Sequence[float], ys: Sequence[float], log_y: bool, x_names: Sequence[str] | None) -> _Axes:
        x_low, x_high = (-0.5, len(x_names) - 0.5) if x_names is not None else (min(xs), max(xs))
        if x_low == x_high:
            x_low, x_high = x_low - 0.5, x_high + 0.5
        y_low, y_high = min(ys), max(ys)
        if log_y:
            # At least half a decade, so that there are tick labels.
            margin = max(1.1, math.sqrt(10.0**0.5 / min(y_high / y_low, 10.0**0.5)))
            return cls(x_low, x_high, y_low / margin, y_high * margin, log_y, x_names)
        margin = 0.06 * (y_high - y_low) or max(abs(y_high), 1.0) * 0.05
        return cls(x_low, x_high, y_low - margin, y_high + margin, log_y, x_names)

    def x(self, value: float) -> float:
        return _LEFT + (value - self.x_low) / (self.x_high - self.x_low) * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        if self.log_y:
            fraction = math.log(value / self.y_low) / math.log(self.y_high / self.y_low)
        else:
            fraction = (value - self.y_low) / (self.y_high - self.y_low)
        return _HEIGHT - _BOTTOM - fraction * (_HEIGHT - _TOP - _BOTTOM)

    def drawn(self, x_label: str, y_label: str) -> list[str]:
        """Grid, ticks and labels."""
        right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
        parts = []
        for tick in (log_ticks if self.log_y else linear_ticks)(self.y_low, self.y_high):
            y = self.y(tick)
            parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{right}"/>')
            parts.append(
                f'<text class="tick" x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{tick_label(tick)}</text>'
            )
        for position, name in self._x_ticks():
            x = self.x(position)
            parts.append(f'<path class="frame" d="M{x:.1f} {bottom}v4"/>')
            parts.append(f'<text class="tick" x="{x:.1f}" y="{bottom + 18}" text-anchor="middle">{escape(name)}</text>')
        parts.append(f'<path class="frame" d="M{_LEFT} {_TOP}V{bottom}H{right}"/>')
        middle = (_LEFT + right) / 2
        parts.append(f'<text class="axis" x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(x_label)}</text>')
        middle = (_TOP + bottom) / 2
        parts.append(
            f'<text class="axis" transform="translate(15 {middle}) rotate(-90)" text-anchor="middle">'
            f"{escape(y_label)}</text>"
        )
        return parts

    def _x_ticks(self) -> list[tuple[float, str]]:
        if self.x_names is None:
            return [(tick, tick_label(tick)) for tick in linear_ticks(self.x_low, self.x_high)]
        longest = max(len(name) for name in self.x_names) + 2
        room = max(1, int((_WIDTH - _LEFT - _RIGHT) / (longest * _LABEL_ROOM)))
        stride = math.ceil(len(self.x_names) / room)
        return [(float(index), self.x_names[index]) for index in range(0, len(self.x_names), stride)]

    def paths(self, line: Series) -> list[str]:
        """One path per uninterrupted segment of a line."""
        stretches: list[list[str]] = [[]]
        for x, y in zip(line.x, line.y, strict=True):
            if math.isfinite(x) and _drawable(y, self.log_y):
                stretches[-1].append(f"{self.x(x):.1f} {self.y(y):.1f}")
            else:
                stretches.append([])
        # A segment of one point is visible too: round caps draw a line of no length as a dot.
        return ["M" + "L".join(s if len(s) > 1 else s * 2) for s in stretches if s]
