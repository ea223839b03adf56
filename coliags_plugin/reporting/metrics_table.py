"""Figures of an evaluation as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table


def figures_table(summary: Mapping[str, Any]) -> Table:
    """One row per figure, one column per test set; a dash where a figure cannot be had.

    Args:
        summary: What ``metrics.json`` holds.
    """
    protocol = summary["protocol"]
    title = f"{summary['method']} on {summary['scene']}, step {summary['step']}"
    table = Table(title=title, caption=f"protocol {protocol['name']} v{protocol['version']}")
    table.add_column("figure")
    for name, figures in summary["sets"].items():
        table.add_column(f"{name} ({figures['frames']} frames)", justify="right")
    for figure, direction in summary["directions"].items():
        arrow = "↑" if direction == "higher" else "↓"
        unit = summary["units"][figure]
        values = [figures.get(figure) for figures in summary["sets"].values()]
        cells = ["-" if value is None else f"{value:.4g}" for value in values]
        table.add_row(f"{figure} {arrow}{f' ({unit})' if unit else ''}", *cells)
    return table
