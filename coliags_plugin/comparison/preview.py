"""What a comparison would do: the state of every cell, and the time and disk that are left to take."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from coliags_plugin.comparison.cells import Cell
from coliags_plugin.comparison.estimates import Estimate, Estimates
from coliags_plugin.comparison.folder import ComparisonFolder, Finished
from coliags_plugin.comparison.states import steps_saved
from coliags_plugin.comparison.text import duration, megabytes
from coliags_plugin.core.errors import InputError
from coliags_plugin.results.display import aligned


@dataclass(frozen=True)
class Row:
    """One cell of a preview.

    Attributes:
        cell: The cell.
        state: ``done``, ``resume``, ``new``, ``same`` as an earlier cell, or ``scene to make`` where that comes first.
        step: Where training starts.
        estimate: What is left; None where nothing is.
    """

    cell: Cell
    state: str
    step: int = 0
    estimate: Estimate | None = None


@dataclass(frozen=True)
class Preview:
    """The rows and sums of a comparison.

    Attributes:
        rows: One per cell.
        phantoms: How many are to be made.
        seconds: Estimated time, the runs at a time taken into account.
        size: Estimated disk, bytes.
        free: Of the disk, bytes.
        slots: Runs at a time.
    """

    rows: Sequence[Row]
    phantoms: int
    seconds: float
    size: float
    free: float
    slots: int

    def line(self) -> str:
        """The sums, in one line."""
        counts = Counter(row.state for row in self.rows)
        states = ", ".join(f"{counts[state]} {state}" for state in dict.fromkeys(row.state for row in self.rows))
        return (
            f"{len(self.rows)} cells: {states}; about {duration(self.seconds)} with {self.slots} at a time, "
            f"about {megabytes(self.size)} of {megabytes(self.free)} of free disk"
        )

    def table(self) -> str:
        """Every cell, and how its time is known."""
        lines = [["cell", "state", "steps", "time", "known from", "disk"]]
        for row in self.rows:
            left = row.estimate
            source = "-" if left is None else "results" if left.measured else "a rough table"
            lines.append(
                [
                    row.cell.title,
                    row.state,
                    f"{row.step} of {row.cell.steps}" if row.step else f"{row.cell.steps}",
                    "-" if left is None else duration(left.seconds),
                    source,
                    "-" if left is None else megabytes(left.kept),
                ]
            )
        return aligned(lines)

    def check_disk(self) -> None:
        """Refuse what cannot fit.

        Raises:
            InputError: The disk is too small.
        """
        if self.size > self.free:
            raise InputError(
                f"the runs need about {megabytes(self.size)}, and the disk has {megabytes(self.free)} left",
                "room for them",
                "Make room, choose another --output, or ask for fewer cells",
            )


def preview(
    cells: Sequence[Cell], folder: ComparisonFolder, finished: Finished, estimates: Estimates, slots: int
) -> Preview:
    """Look at the state of every cell; writes nothing.

    Args:
        cells: What is asked for.
        folder: Where.
        finished: The folder's results.
        estimates: What a cell takes.
        slots: Runs at a time.
    """
    rows, seen = [], set()
    for cell in cells:
        key = None if cell.keys is None else cell.keys.result
        if finished.of(cell) is not None:
            rows.append(Row(cell, "done"))
        elif key is not None and key in seen:
            rows.append(Row(cell, "same"))
        elif not cell.scene.is_there:
            rows.append(Row(cell, "scene to make", 0, estimates.of(cell)))
        else:
            step = steps_saved(folder.run(cell))
            rows.append(Row(cell, "resume" if step else "new", step, estimates.of(cell, step)))
        seen.add(key)
    phantoms = len({row.cell.scene.name for row in rows if row.state == "scene to make"})
    seconds, size = estimates.phantom()
    left = [row.estimate for row in rows if row.estimate is not None]
    running = sorted((each.at_times - each.kept for each in left), reverse=True)[:slots]
    return Preview(
        rows,
        phantoms,
        phantoms * seconds + sum(each.seconds for each in left) / max(1, min(slots, len(left))),
        phantoms * size + sum(each.kept for each in left) + sum(running),
        float(shutil.disk_usage(_existing(folder.path)).free),
        slots,
    )


def _existing(path: Path) -> Path:
    return next(folder for folder in (path, *path.parents) if folder.exists())
