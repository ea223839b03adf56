"""Progress reports of long jobs: a bar on a terminal, one line in a notebook, plain lines elsewhere."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from coliags_plugin.engine.pace import Pace
from coliags_plugin.reporting.numbers import duration

#: Between plain lines, seconds.
PLAIN_LINE_EVERY = 10.0
#: Between changes of a notebook's line, seconds.
NOTEBOOK_LINE_EVERY = 0.5


def open_display(
    console: Console, title: str, total: int, start: int, plain_every: float = PLAIN_LINE_EVERY
) -> TerminalBar | TextDisplay:
    """The display that fits where the console writes to; plain lines come every ``plain_every`` seconds."""
    if console.is_terminal:
        return TerminalBar(console, title, total, start)
    if console.is_jupyter:
        return TextDisplay(title, total, start, NOTEBOOK_LINE_EVERY, NotebookLine().show, at_once=True)
    return TextDisplay(title, total, start, plain_every, lambda text: console.print(text, highlight=False))


class TerminalBar:
    """A bar with the remaining time, once it is known."""

    def __init__(self, console: Console, title: str, total: int, start: int) -> None:
        columns = [
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[facts]}"),
        ]
        self._bar = Progress(*columns, console=console)
        self._bar.start()
        self._task = self._bar.add_task(title, total=total, completed=start, left="", facts="")
        self._pace = Pace(total, start)

    def update(self, done: int, facts: str) -> None:
        """Show how much is done, with facts."""
        self._pace.update(done)
        self._bar.update(self._task, completed=done, left=_to_go(self._pace), facts=facts)

    def close(self) -> None:
        """Leave what was shown last."""
        self._bar.stop()


class TextDisplay:
    """A line of text every so many seconds, the first one at once or not, and one at the end."""

    def __init__(
        self, title: str, total: int, start: int, every: float, show: Callable[[str], None], at_once: bool = False
    ) -> None:
        self._title, self._total, self._every, self._show = title, total, every, show
        self._pace, self._began = Pace(total, start), time.monotonic()
        self._last = -math.inf if at_once else self._began

    def update(self, done: int, facts: str) -> None:
        """Show how much is done, with facts, where it is time to."""
        self._pace.update(done)
        now = time.monotonic()
        if now - self._last >= self._every or done == self._total:
            self._last = now
            self._show(self._line(done, facts, now - self._began))

    def close(self) -> None:
        """Nothing: what was shown last stays."""

    def _line(self, done: int, facts: str, seconds: float) -> str:
        """For instance ``train 3dgs 20/100, 40.0 s to go  loss 0.1``; at the end the time it took."""
        timing = f"took {duration(seconds)}" if done == self._total else _to_go(self._pace)
        return f"{', '.join(filter(None, (f'{self._title} {done}/{self._total}', timing)))}  {facts}".rstrip()


def _to_go(pace: Pace) -> str:
    left = pace.left
    return "" if left is None else f"{duration(left)} to go"


class NotebookLine:
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


class ProgressReport:
    """Progress from ``start`` towards a total, with facts and the remaining time (:class:`Pace`), as a context manager.

    Where there is neither a terminal nor a notebook, a line appears every ``plain_every`` seconds. The console is
    standard error by default.
    """

    def __init__(
        self,
        title: str,
        total: int,
        start: int = 0,
        plain_every: float = PLAIN_LINE_EVERY,
        console: Console | None = None,
    ) -> None:
        self.title = title
        self._total, self._start, self._plain_every, self._console = total, start, plain_every, console
        self._display: TerminalBar | TextDisplay | None = None

    def __enter__(self) -> ProgressReport:
        console = self._console or Console(file=sys.stderr)
        self._display = open_display(console, self.title, self._total, self._start, self._plain_every)
        return self

    def update(self, done: int, facts: str = "") -> None:
        """Report ``done`` of the total, with ``facts`` behind it."""
        if self._display is not None:
            self._display.update(done, facts)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._display is not None:
            self._display.close()


@contextmanager
def progress_callback(after: float = 0.0) -> Iterator[Callable[[str, int, int], None]]:
    """A function ``(title, done, total)`` that shows one report per title, one after the other.

    Nothing is said about what takes less than ``after`` seconds.
    """
    with ExitStack() as stack:
        current: list[ProgressReport] = []
        began: dict[str, float] = {}

        def report(title: str, done: int, total: int) -> None:
            shown = bool(current) and current[-1].title == title
            now = time.monotonic()
            if not shown and now - began.setdefault(title, now) < after:
                return
            if not shown:
                stack.close()
                current.append(stack.enter_context(ProgressReport(title, total, start=done if after else 0)))
            current[-1].update(done)

        yield report


def log_console() -> Console | None:
    """The console that messages go to, so that they appear above a bar; None where they go elsewhere."""
    handlers = logging.getLogger().handlers
    return next((handler.console for handler in handlers if isinstance(handler, RichHandler)), None)
