"""Estimates of what cells will take: time and disk."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median

from coliags_plugin.comparison.cells import Cell
from coliags_plugin.results.record import Result

#: Seconds of a step on one thread of a current CPU by kind of field, for images of 338 x 270: what is used where no
#: result of the method tells. Measured on two cores (docs/comparing.md 4).
_ROUGH_STEP = {"anchors": 0.16, "gaussians": 0.10, "surfels": 0.14, "lit-gaussians": 0.20, "reim-nerf": 4.0}
_OTHER_STEP = 0.15
_ROUGH_PIXELS = 338 * 270
#: Of starting a process, reading a scene and evaluating, seconds.
_ROUGH_OVERHEAD = 30.0
#: Of a run's checkpoints, three at times, and of the images of its evaluation, bytes.
_ROUGH_BYTES = 200_000_000


@dataclass(frozen=True)
class Estimate:
    """What a cell will take from the beginning.

    Attributes:
        seconds: Time.
        bytes_to_write: Disk.
        measured: Whether results of the method tell the time.
    """

    seconds: float
    bytes_to_write: float
    measured: bool


class Estimates:
    """Estimates by method, from results where there are any.

    Args:
        results: Results whose costs are known.
    """

    def __init__(self, results: Iterable[Result]) -> None:
        self._steps: dict[str, list[float]] = {}
        for result in results:
            if result.cost.train_seconds and result.steps:
                seconds = result.cost.train_seconds / result.steps
                self._steps.setdefault(result.method, []).append(seconds)

    def of(self, cell: Cell) -> Estimate:
        """The estimate of a cell."""
        known = self._steps.get(cell.variant.name)
        step = median(known) if known else _ROUGH_STEP.get(cell.config.field.name, _OTHER_STEP)
        return Estimate(step * cell.steps + _ROUGH_OVERHEAD, _ROUGH_BYTES, bool(known))
