"""Report of a running comparison: a table on a terminal, a line per event elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.states import CellState

log = logging.getLogger(__name__)

Show = Callable[[Sequence[CellState]], None]


@contextmanager
def live_table(folder: ComparisonFolder) -> Iterator[Show]:
    """A function that reports the states of all cells."""
    shown: dict[tuple[str, str, int, str], str] = {}

    def events(states: Sequence[CellState]) -> None:
        done = sum(state.phase in ("done", "failed") for state in states)
        for state in states:
            before = shown.get(state.cell.identity)
            shown[state.cell.identity] = state.phase
            if state.phase == before or (before is None and state.phase in ("waiting", "done")):
                continue
            reason = f": {state.reason}" if state.reason else ""
            log.info("[%d/%d] %s: %s%s", done, len(states), state.cell.title, state.phase, reason)

    yield events
