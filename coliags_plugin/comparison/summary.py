"""Summary of a comparison as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from coliags_plugin.comparison.cells import Cell
from coliags_plugin.comparison.folder import Failure
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.results.display import Table
from coliags_plugin.results.record import Result

#: Metrics shown unless others are chosen.
COLUMNS = ("psnr", "ssim", "depth_mse")


def summary_table(
    cells: Sequence[Cell], results: Sequence[Result], failures: Sequence[Failure] = (), columns: Sequence[str] = COLUMNS
) -> Table:
    """Means over the finished cells of every method, of their main test sets; None where there is no value.

    Args:
        cells: What was asked for.
        results: Of those that are done.
        failures: Of those that are not, for the notes.
        columns: Names of metrics.

    Raises:
        InputError: No result has one of the metrics.
    """
    units = {name: metric.unit for result in results for name, metric in result.metrics.items()}
    for name in columns:
        if results and name not in units:
            raise InputError(f"no metric '{name}'", f"one of {', '.join(units)}", did_you_mean(name, units))
    asked = Counter(cell.variant.name for cell in cells)
    own: dict[str, list[Result]] = {method: [] for method in asked}
    for result in results:
        own[result.method].append(result)
    return Table(
        f"{len(results)} of {len(cells)} cells",
        ("method", "done", *columns),
        [
            {
                "method": method,
                "done": f"{len(own[method])} of {count}",
                **{name: _mean(own[method], name) for name in columns},
            }
            for method, count in asked.items()
        ],
        {name: f"{name} ({unit})" for name, unit in units.items() if unit},
        [f"failed: {each.scene} {each.method} seed {each.seed}: {each.reason}" for each in failures],
    )


def _mean(results: Sequence[Result], metric: str) -> float | None:
    own = [result for result in results if metric in result.metrics]
    means = [mean for result in own if (mean := result.mean(metric)) is not None]
    return sum(means) / len(means) if means else None
