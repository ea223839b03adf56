"""Estimates of what cells will take: time and disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from coliags_plugin.comparison.cells import Cell, file_name
from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.results.record import Result

#: Seconds of a step on one thread, for images of 338 x 270, by method or else kind of field (docs/comparing.md 4).
_ROUGH_STEP = {
    "anchors": 0.16,
    "gaussians": 0.10,
    "surfels": 0.14,
    "lit-gaussians": 0.20,
    "reim-nerf": 7.5,
    "reim-nerf-small": 0.14,
}
_ROUGH_STEP_OF_OTHERS = 0.15
#: Likewise of rendering the views of the test sets, where that is long.
_ROUGH_EVALUATION = {"reim-nerf": 5000.0, "reim-nerf-small": 100.0}
_ROUGH_EVALUATION_OF_OTHERS = 10.0
#: Starting a process and reading a scene, seconds.
_ROUGH_START = 20.0
#: A run folder: a checkpoint, and the images of its evaluation, bytes.
_ROUGH_CHECKPOINT, _ROUGH_IMAGES = 40e6, 30e6
#: Checkpoints that are there at times besides the one that stays: the one before, and one being written.
_CHECKPOINTS_AT_TIMES = 2
#: Making a phantom, seconds and bytes.
_ROUGH_PHANTOM = (90.0, 70e6)


@dataclass(frozen=True)
class Estimate:
    """What a cell will take.

    Attributes:
        seconds: Time.
        kept: Disk when it is done, bytes.
        at_times: Disk while it is running, bytes.
        measured: Whether the time comes from results of the method, and not from a table.
    """

    seconds: float
    kept: float
    at_times: float
    measured: bool


class Estimates:
    """Estimates by method, from what its finished cells took, if there are any.

    Args:
        folder: Of the comparison, whose finished runs are measured.
        results: Finished cells by results file.
    """

    def __init__(self, folder: ComparisonFolder, results: Mapping[Path, Result]) -> None:
        self._steps: dict[str, list[float]] = {}
        self._evaluations: dict[str, list[float]] = {}
        self._checkpoints: dict[str, list[float]] = {}
        for result in results.values():
            if result.cost.train_seconds and result.steps:
                self._steps.setdefault(result.method, []).append(result.cost.train_seconds / result.steps)
            if result.cost.render_fps:
                views = sum(len(part.frames) for part in result.sets.values())
                self._evaluations.setdefault(result.method, []).append(views / result.cost.render_fps)
            if result.cost.checkpoint_bytes:
                self._checkpoints.setdefault(result.method, []).append(float(result.cost.checkpoint_bytes))
        self._runs = folder.path / "runs"
        self._sizes: dict[str, list[float]] = {}

    def of(self, cell: Cell, steps_done: int = 0) -> Estimate:
        """The estimate of a cell.

        Args:
            cell: The cell.
            steps_done: Steps that need not be repeated.
        """
        name = cell.variant.name
        step = median(self._steps.get(name, [_rough(_ROUGH_STEP, cell, _ROUGH_STEP_OF_OTHERS)]))
        views = median(self._evaluations.get(name, [_rough(_ROUGH_EVALUATION, cell, _ROUGH_EVALUATION_OF_OTHERS)]))
        checkpoint = median(self._checkpoints.get(name, [_ROUGH_CHECKPOINT]))
        kept = median(self._sizes_of(cell) or [checkpoint + _ROUGH_IMAGES])
        return Estimate(
            step * (cell.steps - steps_done) + views + _ROUGH_START,
            kept,
            kept + _CHECKPOINTS_AT_TIMES * checkpoint,
            name in self._steps,
        )

    def phantom(self) -> tuple[float, float]:
        """Seconds and bytes of making a phantom."""
        return _ROUGH_PHANTOM

    def _sizes_of(self, cell: Cell) -> list[float]:
        """Sizes of the method's finished runs, bytes."""
        name = file_name(cell.variant.name)
        if name not in self._sizes:
            runs = [path.parent for path in self._runs.glob(f"*/{name}/*/eval")]
            self._sizes[name] = [float(_size(run)) for run in runs]
        return self._sizes[name]


def _rough(table: Mapping[str, float], cell: Cell, other: float) -> float:
    return table.get(cell.variant.method, table.get(cell.config.field.name, other))


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
