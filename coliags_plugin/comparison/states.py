"""Progress of the cells of a comparison, read from their run folders."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from coliags_plugin.comparison.cells import Cell
from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.core.json_files import parse_json
from coliags_plugin.engine.checkpoints import newest_checkpoint
from coliags_plugin.engine.run_folder import RunFolder

Phase = Literal["waiting", "running", "done", "failed"]

#: Read of the end of a log, bytes: the last rows.
_TAIL = 8192


@dataclass
class CellState:
    """Where a cell stands.

    Attributes:
        cell: The cell.
        phase: What is being done.
        step: Steps taken.
        psnr: Of the last logged training view, dB.
        seconds_per_step: Of the last logged steps.
        reason: Why it failed.
    """

    cell: Cell
    phase: Phase = "waiting"
    step: int = 0
    psnr: float | None = None
    seconds_per_step: float | None = None
    reason: str = ""

    @property
    def evaluating(self) -> bool:
        """Whether training is over and the result is not there yet."""
        return self.phase == "running" and self.step >= self.cell.steps

    @property
    def seconds_left(self) -> float | None:
        """Of training; None where it cannot be told."""
        if self.phase != "running" or self.seconds_per_step is None:
            return None
        return self.seconds_per_step * (self.cell.steps - self.step)


class Watch:
    """The states of all cells.

    Args:
        folder: Where the runs are.
        cells: The cells.
    """

    def __init__(self, folder: ComparisonFolder, cells: Sequence[Cell]) -> None:
        self._folder = folder
        self._states = {cell.identity: CellState(cell) for cell in cells}

    @property
    def states(self) -> list[CellState]:
        """In the order of the cells."""
        return list(self._states.values())

    def waiting(self, cell: Cell) -> None:
        """It is to be started, perhaps again."""
        self._states[cell.identity].phase = "waiting"

    def started(self, cell: Cell) -> None:
        """A worker has it."""
        self._states[cell.identity].phase = "running"

    def done(self, cell: Cell) -> None:
        """Its result is there."""
        state = self._states[cell.identity]
        state.phase, state.step = "done", cell.steps

    def failed(self, cell: Cell, reason: str) -> None:
        """It has no result."""
        state = self._states[cell.identity]
        state.phase, state.reason = "failed", reason

    def look(self) -> None:
        """Read the progress of all that are being worked on."""
        for state in self._states.values():
            if state.phase == "running":
                _read_progress(RunFolder(self._folder.run(state.cell)).log_file, state)


def steps_saved(run: Path) -> int:
    """Steps after which a run would go on: those of its newest checkpoint."""
    newest = newest_checkpoint(RunFolder(run).checkpoints)
    return 0 if newest is None else int(newest.name.split("-")[1])


def _read_progress(file: Path, state: CellState) -> None:
    rows = _last_rows(file)
    if not rows:
        return
    first, last = rows[0], rows[-1]
    state.step, state.psnr = last["step"], last.get("psnr")
    steps = last["step"] - first["step"]
    if steps > 0:
        state.seconds_per_step = (last["seconds"] - first["seconds"]) / steps


def _last_rows(file: Path) -> list[dict[str, Any]]:
    """The last rows of a log; a line that is cut short is left out."""
    try:
        with file.open("rb") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(0, size - _TAIL))
            lines = log.read().splitlines()[1 if size > _TAIL else 0 :]
    except OSError:
        return []
    rows = []
    for line in lines:
        try:
            row = parse_json(line)
        except ValueError:
            continue
        if isinstance(row, dict) and {"step", "seconds"} <= row.keys():
            rows.append(row)
    return rows
