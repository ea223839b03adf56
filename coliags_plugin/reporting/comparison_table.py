"""Comparison table of methods by metrics: columns, decimals and ranks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from coliags_plugin.reporting.run_data import SEEN_SUFFIX, EvaluatedRun

_NAMES = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "lpips_squeeze": "LPIPS, SqueezeNet",
    "depth_mse": "Depth MSE",
    "depth_mse_inner": "Depth MSE, inner",
    "depth_rmse": "Depth RMSE",
    "depth_mae": "Depth MAE",
    "depth_median_error": "Depth median error",
    "depth_abs_rel": "Depth AbsRel",
}
_SIGNIFICANT = 3
_MOST_DECIMALS = 4

Direction = Literal["higher", "lower"]


@dataclass(frozen=True)
class Column:
    """One metric of one test set over the runs.

    Attributes:
        metric: Name in the run folders.
        unit: As recorded; empty for a plain number.
        direction: Whether higher or lower is better; None where no run says, then nothing is ranked.
        values: One per run; None where unavailable.
    """

    metric: str
    unit: str
    direction: Direction | None
    values: Sequence[float | None]

    @property
    def title(self) -> str:
        """Column heading."""
        return metric_title(self.metric)

    @property
    def decimals(self) -> int:
        """Decimals of every value of the column: 2 for dB, 4 for plain numbers, else 3 digits of the smallest."""
        if self.unit == "dB":
            return 2
        if self.unit in ("", "1"):
            return 4
        sizes = [abs(value) for value in self.values if value]
        if not sizes:
            return 2
        return min(max(_SIGNIFICANT - 1 - math.floor(math.log10(min(sizes))), 0), _MOST_DECIMALS)

    def text(self, value: float) -> str:
        """Value formatted for the table."""
        return f"{value:.{self.decimals}f}"

    def ranks(self) -> list[int | None]:
        """Rank of each run from 1 on, by the printed value; equal values share a rank and the next one is skipped.

        None where a value is unavailable, and everywhere with fewer than two values.
        """
        if self.direction is None:
            return [None] * len(self.values)
        sign = -1.0 if self.direction == "higher" else 1.0
        keys = [None if value is None else sign * float(self.text(value)) for value in self.values]
        known = [key for key in keys if key is not None]
        if len(known) < 2:
            return [None] * len(keys)
        return [None if key is None else 1 + sum(other < key for other in known) for key in keys]


def columns(runs: Sequence[EvaluatedRun], set_name: str) -> list[Column]:
    """Columns of a test set's table, each metric followed by the same over the seen pixels.

    A metric over the seen pixels that only other sets have gets no column.
    """
    directions: dict[str, Direction] = {}
    units: dict[str, str] = {}
    present: dict[str, None] = {}
    for run in runs:
        directions.update(run.record.directions)
        units.update(run.record.units)
        means = run.record.sets.get(set_name, {})
        present.update(dict.fromkeys(name for name, value in means.items() if name != "frames" and _is_value(value)))
    listed = [name for base in directions for name in (base, base + SEEN_SUFFIX) if name in present]
    ordered = [name for name in dict.fromkeys([*listed, *present]) if not _belongs_elsewhere(runs, set_name, name)]
    return [
        Column(
            metric=name,
            unit=units.get(name, units.get(name.removesuffix(SEEN_SUFFIX), "")),
            direction=directions.get(name, directions.get(name.removesuffix(SEEN_SUFFIX))),
            values=[run.mean(set_name, name) for run in runs],
        )
        for name in ordered
    ]


def _belongs_elsewhere(runs: Sequence[EvaluatedRun], set_name: str, metric: str) -> bool:
    if not metric.endswith(SEEN_SUFFIX):
        return False
    having = {name for run in runs for name in run.record.sets if run.mean(name, metric) is not None}
    return bool(having) and set_name not in having


def metric_title(metric: str) -> str:
    """Title of a metric, for instance "PSNR, seen pixels"."""
    base = metric.removesuffix(SEEN_SUFFIX)
    title = _NAMES.get(base) or base.replace("_", " ").capitalize()
    return f"{title}, seen pixels" if metric != base else title


def unit_text(unit: str) -> str:
    """Unit with typographic exponents: ``mm^2`` as mm²."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def _is_value(value: object) -> bool:
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))
