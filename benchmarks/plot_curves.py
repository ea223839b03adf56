"""Training curves of several runs as one SVG figure.

python benchmarks/plot_curves.py --out docs/curves/c3vd.svg --curves "coliags=RUN/curve.jsonl" "none=OTHER/curve.jsonl"
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import tyro

from coliags_plugin.core.files import atomic_write
from coliags_plugin.reporting.html_page import html_blocks
from coliags_plugin.reporting.model import Chart, Figures, Series

#: What is drawn: key of a row, axis label, whether the axis is logarithmic.
PANELS = (
    ("psnr", "PSNR, dB", False),
    ("rotation_psnr", "PSNR, rotation views, dB", False),
    ("depth_mse_inner", "depth MSE, inner, mm²", True),
    ("depth_median_error", "depth error, median, mm", True),
    ("ssim", "SSIM", False),
    ("elements", "anchors or Gaussians", False),
)
# As in the report.
COLORS = ("#0b62b0", "#c8500a", "#15803d", "#a2307f", "#8a6a00", "#0e7c86", "#6d4bc3", "#b3261e")
WIDTH, HEIGHT, LEGEND = 600, 300, 24
#: Room to the right for the last tick label.
MARGIN = 16

STYLE = """
text { font-family: system-ui, sans-serif; fill: #1b1f24; font-size: 13px; }
.chart { overflow: visible; }
.chart .tick { fill: #5b6470; font-size: 12.5px; }
.frame { fill: none; stroke: #5b6470; stroke-width: 1; }
.grid { fill: none; stroke: #e9ecf0; stroke-width: 1; }
.line { fill: none; stroke: currentColor; stroke-width: 2; stroke-linejoin: round; stroke-linecap: round; }
.dash1 .line { stroke-dasharray: 6 4; }
"""


@dataclass(frozen=True)
class Options:
    """Draw training curves."""

    out: Path
    """SVG to write."""
    curves: tuple[str, ...]
    """LABEL=FILE for each line, FILE as benchmarks/training_curve.py writes it."""
    panels: str = ",".join(key for key, _, _ in PANELS)
    """Which figures, comma separated."""


def read_curve(argument: str) -> tuple[str, list[dict[str, Any]]]:
    """``LABEL=FILE`` -> label and rows."""
    label, _, file = argument.partition("=")
    return label, [json.loads(line) for line in Path(file).read_text(encoding="utf-8").splitlines()]


def panel(curves: list[tuple[str, list[dict[str, Any]]]], key: str, label: str, log_y: bool) -> str:
    """One chart."""
    series = [
        Series(name, style, [row["step"] for row in rows if key in row], [row[key] for row in rows if key in row])
        for style, (name, rows) in enumerate(curves)
    ]
    page = html_blocks([Figures([Chart(series, "step", label, log_y=log_y)])])  # nothing where there is no point
    return "".join(re.findall("(?s)<svg.*</svg>", page))


def legend(names: list[str], top: int) -> list[str]:
    """A coloured line and a name for each curve, two to a row."""
    parts = []
    for style, name in enumerate(names):
        x, y = 68 + (style % 2) * WIDTH, top + (style // 2) * LEGEND
        parts.append(f'<g class="s{style}"><path class="line" d="M{x} {y}h28"/></g>')
        parts.append(f'<text x="{x + 36}" y="{y + 4}">{escape(name)}</text>')
    return parts


def figure(curves: list[tuple[str, list[dict[str, Any]]]], keys: list[str]) -> str:
    """All panels, two to a row, under a legend."""
    head = 12 + LEGEND * -(-len(curves) // 2)
    charts = [panel(curves, key, label, log_y) for key, label, log_y in PANELS if key in keys]
    charts = [chart for chart in charts if chart]
    height = head + HEIGHT * -(-len(charts) // 2)
    colors = "".join(f".s{index} {{ color: {color}; }}" for index, color in enumerate(COLORS))
    width = 2 * WIDTH + MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">',
        f"<style>{STYLE}{colors}</style>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        *legend([name for name, _ in curves], LEGEND - 4),
    ]
    for index, chart in enumerate(charts):
        x, y = (index % 2) * WIDTH, head + (index // 2) * HEIGHT
        parts.append(chart.replace("<svg ", f'<svg x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" ', 1))
    return "\n".join([*parts, "</svg>"]) + "\n"


def main(options: Options) -> None:
    """Read, draw, write."""
    curves = [read_curve(argument) for argument in options.curves]
    atomic_write(options.out, figure(curves, options.panels.split(",")))


if __name__ == "__main__":
    main(tyro.cli(Options))
