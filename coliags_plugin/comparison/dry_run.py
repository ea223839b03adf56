"""What a comparison would do: the state of every cell, and the disk that it would take."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from coliags_plugin.comparison.folder import ComparisonFolder, FinishedCells
from coliags_plugin.comparison.plan import ComparisonCell
from coliags_plugin.comparison.plan_file import RUNS, file_name
from coliags_plugin.core.errors import InputError
from coliags_plugin.reporting.model import Column
from coliags_plugin.reporting.numbers import file_size
from coliags_plugin.reporting.terminal import DisplayTable

#: Assumed size of a run folder while no run of its method is finished, and of a phantom, bytes.
_RUN_BYTES, _PHANTOM_BYTES = 70e6, 70e6


class RunSizes:
    """Sizes of run folders by method: the median of the finished ones, if there are any.

    While it is worked on, a run has more checkpoints and may take twice that.
    """

    def __init__(self, folder: ComparisonFolder) -> None:
        self._runs = folder.path / RUNS
        self._known: dict[str, float] = {}

    def of(self, cell: ComparisonCell) -> float:
        """Size of a cell's run, bytes."""
        name = file_name(cell.variant.name)
        if name not in self._known:
            runs = [path.parent for path in self._runs.glob(f"*/{name}/*/eval")]
            sizes = [sum(file.stat().st_size for file in run.rglob("*") if file.is_file()) for run in runs]
            self._known[name] = float(median(sizes)) if sizes else _RUN_BYTES
        return self._known[name]


@dataclass(frozen=True)
class CellForecast:
    """What would be done for one cell."""

    cell: ComparisonCell
    state: str  # done, resume, new, same (as an earlier cell), or scene to make
    step: int = 0  # where training starts
    size: float = 0.0  # disk that it takes, bytes
    changed: str = ""  # why it is done anew: what has changed since it was done, for instance ``code``


@dataclass(frozen=True)
class DryRun:
    """The cells of a comparison, and their disk."""

    cells: Sequence[CellForecast]
    size: float  # disk that is needed, bytes
    free: float  # of the disk, bytes

    def __str__(self) -> str:
        """Counts and disk, in one line."""
        counts = Counter(each.state for each in self.cells)
        states = ", ".join(f"{count} {state}" for state, count in counts.items())
        return f"{len(self.cells)} cells: {states}; about {file_size(self.size)} of {file_size(self.free)} of free disk"

    def table(self) -> DisplayTable:
        """Every cell with its state, steps and disk."""
        rows = [
            {
                "cell": each.cell.title,
                "state": each.state,
                "steps": f"{each.step} of {each.cell.steps}" if each.step else str(each.cell.steps),
                "disk": file_size(each.size) if each.size else None,
                "changed": each.changed or None,
            }
            for each in self.cells
        ]
        columns = [Column("cell"), Column("state", words=True), Column("steps"), Column("disk")]
        if any(each.changed for each in self.cells):
            columns.append(Column("changed", "done before, but changed", words=True))
        return DisplayTable(str(self), columns, rows)

    def check_disk(self) -> None:
        """Refuse what cannot fit."""
        if self.size > self.free:
            raise InputError(
                f"the runs need about {file_size(self.size)}, and the disk has {file_size(self.free)} left",
                "room for them",
                "Make room, choose another --output, or ask for fewer cells",
            )


def forecast(
    cells: Sequence[ComparisonCell], folder: ComparisonFolder, finished: FinishedCells, sizes: RunSizes, slots: int
) -> DryRun:
    """Look at the state of every cell; writes nothing."""
    forecasts: list[CellForecast] = []
    keys: set[str | None] = set()
    for cell in cells:
        key = None if cell.keys is None else cell.keys.result
        if finished.of(cell) is not None:
            forecasts.append(CellForecast(cell, "done"))
        elif key is not None and key in keys:
            forecasts.append(CellForecast(cell, "same"))
        elif not cell.scene.is_there:
            forecasts.append(CellForecast(cell, "scene to make", size=sizes.of(cell)))
        else:
            step = folder.run(cell).step
            state = "resume" if step else "new"
            forecasts.append(CellForecast(cell, state, step, sizes.of(cell), finished.changes(cell)))
        keys.add(key)
    phantoms = len({each.cell.scene.name for each in forecasts if each.state == "scene to make"})
    ordered = sorted((each.size for each in forecasts), reverse=True)
    disk = next(path for path in (folder.path, *folder.path.parents) if path.exists())
    return DryRun(
        forecasts, phantoms * _PHANTOM_BYTES + sum(ordered) + sum(ordered[:slots]), float(shutil.disk_usage(disk).free)
    )
