"""Metrics of an evaluation as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table


def metrics_table(summary: Mapping[str, Any]) -> Table:
    """Table of one row per metric and one column per test set; unavailable values are dashes.

    Args:
        summary: The content of ``metrics.json``.
    """
    protocol = summary["protocol"]
    title = f"{summary['method']} on {summary['scene']}, step {summary['step']}"
    table = Table(title=title, caption=f"protocol {protocol['name']} v{protocol['version']}")
    table.add_column("metric")
    for name, values in summary["sets"].items():
        table.add_column(f"{name} ({values['frames']} frames)", justify="right")
    for metric, direction in summary["directions"].items():
        arrow = "↑" if direction == "higher" else "↓"
        unit = summary["units"][metric]
        means = [values.get(metric) for values in summary["sets"].values()]
        cells = ["-" if mean is None else f"{mean:.4g}" for mean in means]
        table.add_row(f"{metric} {arrow}{f' ({unit})' if unit else ''}", *cells)
    return table
