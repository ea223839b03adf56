"""Report of a running comparison: a table on a terminal, a line in a notebook, a line per event elsewhere."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.logging import RichHandler
from rich.table import Table

from coliags_plugin.comparison.states import CellState
from coliags_plugin.comparison.text import duration
from coliags_plugin.engine.progress_displays import NotebookText

log = logging.getLogger(__name__)

Show = Callable[[Sequence[CellState]], None]

#: Rows of the table besides those of running cells.
_OTHERS = 6
_STYLES = {"running": "bold", "failed": "red", "done": "green", "waiting": "dim"}


@contextmanager
def live_report() -> Iterator[Show]:
    """A function that reports the states of all cells: as what is redrawn, or a line for each change."""
    console = _log_console() or Console(file=sys.stderr)
    if console.is_jupyter:
        text = NotebookText()
        yield lambda states: text.show(states_line(states))
        return
    if not console.is_terminal:
        yield _Events().show
        return
    with Live(console=console, refresh_per_second=2, transient=True) as live:
        events = _Events(only=("failed",))

        def show(states: Sequence[CellState]) -> None:
            events.show(states)
            live.update(states_table(states))

        yield show


def states_table(states: Sequence[CellState]) -> Table:
    """Running and failed cells, then some of those that wait and are done; counts in the title."""
    table = Table("cell", "state", "step", "PSNR dB", "time left", title=_counts(states), title_justify="left")
    for state in _shown(states):
        left = state.seconds_left
        table.add_row(
            state.cell.title,
            state.reason or ("evaluating" if state.evaluating else state.phase),
            f"{state.step}/{state.cell.steps}",
            "" if state.psnr is None else f"{state.psnr:.2f}",
            "" if left is None else duration(left),
            style=_STYLES[state.phase],
        )
    return table


def states_line(states: Sequence[CellState]) -> str:
    """Counts, and how far running cells are."""
    running = [f"{each.cell.title} {each.step}/{each.cell.steps}" for each in states if each.phase == "running"]
    return "; ".join([_counts(states), *running])


def _counts(states: Sequence[CellState]) -> str:
    counts = Counter(state.phase for state in states)
    return ", ".join(f"{count} {phase}" for phase, count in counts.items())


class _Events:
    """Logs changes of phases.

    Args:
        only: Phases to tell of; empty: all.
    """

    def __init__(self, only: Sequence[str] = ()) -> None:
        self._only = only
        self._told: dict[tuple[str, str, int, str], str] | None = None

    def show(self, states: Sequence[CellState]) -> None:
        """Log what has changed since the last call; at first, what is not as it was found."""
        now = {state.cell.identity: state.phase for state in states}
        before = self._told if self._told is not None else {}
        ended = sum(phase in ("done", "failed") for phase in now.values())
        for state in states:
            phase, last = state.phase, before.get(state.cell.identity)
            known = phase in ("waiting", "done") if last is None else phase == last
            if known or (self._only and phase not in self._only):
                continue
            log.info("[%d/%d] %s", ended, len(states), _event(state))
        self._told = dict(now)


def _event(state: CellState) -> str:
    if state.phase == "failed":
        return f"{state.cell.title}: failed: {state.reason}"
    shown = "" if state.psnr is None or state.phase != "done" else f", {state.psnr:.2f} dB on the last training view"
    return f"{state.cell.title}: {state.phase}{shown}"


def _shown(states: Sequence[CellState]) -> list[CellState]:
    """Running and failed cells, the last that were done, and the next ones."""
    of = {phase: [state for state in states if state.phase == phase] for phase in _STYLES}
    return [*of["failed"], *of["done"][-_OTHERS // 2 :], *of["running"], *of["waiting"][: _OTHERS // 2]]


def _log_console() -> Console | None:
    """The console that messages go to, so that they appear above the table."""
    handlers = logging.getLogger().handlers
    return next((handler.console for handler in handlers if isinstance(handler, RichHandler)), None)
