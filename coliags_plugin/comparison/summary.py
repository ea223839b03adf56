"""Summary of a comparison as plain text."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.cells import Cell
from coliags_plugin.comparison.text import aligned
from coliags_plugin.results.record import Result

#: Column titles and metrics.
_COLUMNS = {"PSNR dB": "psnr", "SSIM": "ssim", "depth MSE mm2": "depth_mse"}


def summary_table(cells: Sequence[Cell], results: Sequence[Result]) -> str:
    """Means over the finished cells of every method, of its own test set; ``-`` where there is no value.

    Args:
        cells: What was asked for.
        results: Of those that are done.
    """
    rows = [["method", "done", *_COLUMNS]]
    for name in dict.fromkeys(cell.variant.name for cell in cells):
        asked = sum(cell.variant.name == name for cell in cells)
        own = [result for result in results if result.method == name]
        rows.append([name, f"{len(own)} of {asked}", *(_mean(own, metric) for metric in _COLUMNS.values())])
    return aligned(rows)


def _mean(results: Sequence[Result], metric: str) -> str:
    means = [mean for result in results if (mean := result.sets[result.main_set].mean(metric)) is not None]
    return f"{sum(means) / len(means):.3f}" if means else "-"
