"""Where progress is shown: a bar on a terminal, one line in a notebook, plain lines elsewhere."""

from __future__ import annotations

import math
import time
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

#: Between plain lines, seconds.
PLAIN_LINE_EVERY = 10.0
#: Between changes of a notebook's line, seconds.
NOTEBOOK_LINE_EVERY = 0.5


class Display(Protocol):
    """Protocol of what shows the progress towards a total."""

    def update(self, done: int, facts: str) -> None:
        """Show how much is done, with facts."""

    def close(self) -> None:
        """Leave what was shown last."""


def open_display(
    console: Console, title: str, total: int, start: int, plain_every: float = PLAIN_LINE_EVERY
) -> Display:
    """The display that fits where the console writes to.

    Args:
        console: The console.
        title: What is being done.
        total: Where the count ends.
        start: Where it begins.
        plain_every: Between plain lines, seconds.
    """
    if console.is_terminal:
        return TerminalBar(console, title, total, start)
    counted = Counted(title, total, start)
    return NotebookLine(counted) if console.is_jupyter else PlainLines(console, counted, plain_every)


class TerminalBar:
    """A bar with the remaining time."""

    def __init__(self, console: Console, title: str, total: int, start: int) -> None:
        columns = [
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[facts]}"),
        ]
        self._bar = Progress(*columns, console=console)
        self._bar.start()
        self._task = self._bar.add_task(title, total=total, completed=start, facts="")

    def update(self, done: int, facts: str) -> None:
        """See :class:`Display`."""
        self._bar.update(self._task, completed=done, facts=facts)

    def close(self) -> None:
        """See :class:`Display`."""
        self._bar.stop()


class Counted:
    """Text of a count with the time.

    Args:
        title: What is being done.
        total: Where the count ends.
        start: Where it begins.
    """

    def __init__(self, title: str, total: int, start: int) -> None:
        self.title, self.total, self.first = title, total, start
        self.began = time.monotonic()

    def text(self, done: int, facts: str) -> str:
        """For instance ``train 3dgs 20/100, 40 s to go  loss 0.1``; at the end the time it took."""
        seconds = time.monotonic() - self.began
        left = seconds / max(1, done - self.first) * (self.total - done)
        timing = f"took {seconds:.0f} s" if done == self.total else f"{left:.0f} s to go"
        return f"{self.title} {done}/{self.total}, {timing}  {facts}".rstrip()


class PlainLines:
    """A line every so many seconds, and one at the end."""

    def __init__(self, console: Console, counted: Counted, every: float) -> None:
        self._console, self._counted, self._every = console, counted, every
        self._last = counted.began

    def update(self, done: int, facts: str) -> None:
        """See :class:`Display`."""
        now = time.monotonic()
        if now - self._last >= self._every or done == self._counted.total:
            self._last = now
            self._console.print(self._counted.text(done, facts), highlight=False)

    def close(self) -> None:
        """See :class:`Display`."""


class NotebookLine:
    """One line that changes, of which a saved notebook keeps the last state."""

    def __init__(self, counted: Counted) -> None:
        self._counted = counted
        self._last = -math.inf
        self._text = NotebookText()

    def update(self, done: int, facts: str) -> None:
        """See :class:`Display`."""
        now = time.monotonic()
        if now - self._last >= NOTEBOOK_LINE_EVERY or done == self._counted.total:
            self._last = now
            self._text.show(self._counted.text(done, facts))

    def close(self) -> None:
        """See :class:`Display`."""


class NotebookText:
    """Text in the output of a notebook's cell that can be replaced."""

    def __init__(self) -> None:
        self._shown: Any = None

    def show(self, text: str) -> None:
        """Show a text instead of the one before."""
        if self._shown is None:
            from IPython import display

            show: Any = display.display  # which has no types
            self._shown = show({"text/plain": text}, raw=True, display_id=True)
        else:
            self._shown.update({"text/plain": text}, raw=True)
