"""Progress of long jobs, a bar on a terminal, one line in a notebook, plain lines elsewhere; and the log beside it."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import Any, TextIO

from rich.console import Console, ConsoleRenderable
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.traceback import Traceback

from coliags_plugin.reporting.numbers import duration

#: Between plain lines, seconds.
PLAIN_LINE_EVERY = 10.0
#: Between changes of a notebook's line, seconds.
NOTEBOOK_LINE_EVERY = 0.5
#: Over which the speed is estimated, seconds: one slow step does not change the remaining time by much.
SPEED_OVER = 120.0


class ProgressReport:
    """Progress from ``start`` towards a total, with facts and the remaining time, as a context manager.

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
        self._console = console or Console(file=sys.stderr)
        self._every = NOTEBOOK_LINE_EVERY if self._console.is_jupyter else plain_every
        self._last = -math.inf if self._console.is_jupyter else time.monotonic()
        self._notebook_line: Any = None
        columns = [
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[facts]}"),
        ]
        self._bar = Progress(
            *columns,
            console=self._console,
            disable=not self._console.is_terminal,
            speed_estimate_period=SPEED_OVER,
            get_time=time.monotonic,
        )
        self._task = self._bar.add_task(title, total=total, completed=start, facts="")

    def __enter__(self) -> ProgressReport:
        self._bar.start()
        return self

    def update(self, done: int, facts: str = "") -> None:
        """Report ``done`` of the total, with ``facts`` behind it."""
        self._bar.update(self._task, completed=done, facts=facts)
        now = time.monotonic()
        if self._bar.disable and (now - self._last >= self._every or self._bar.finished):
            self._last = now
            self._show(self._line())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._bar.disable:
            self._bar.stop()

    def _line(self) -> str:
        """For instance ``train 3dgs 20/100, 40.0 s to go  loss 0.1``; at the end the time it took."""
        (task,) = self._bar.tasks
        parts = [f"{self.title} {task.completed}/{task.total}"]
        if task.finished:
            parts.append(f"took {duration(task.elapsed or 0.0)}")
        elif task.time_remaining is not None:
            parts.append(f"{duration(task.time_remaining)} to go")
        return f"{', '.join(parts)}  {task.fields['facts']}".rstrip()

    def _show(self, text: str) -> None:
        if not self._console.is_jupyter:
            self._console.print(text, highlight=False)
        elif self._notebook_line is not None:
            self._notebook_line.update({"text/plain": text}, raw=True)
        else:
            from IPython import display

            show: Any = display.display  # which has no types
            self._notebook_line = show({"text/plain": text}, raw=True, display_id=True)


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


class LogLines(RichHandler):
    """One line per message, above a progress bar: not broken to the width, so that paths and commands can be copied.

    Args:
        stream: Where the lines go.
        worded: Puts a message into the words of its reader.
    """

    def __init__(self, stream: TextIO, worded: Callable[[str], str]) -> None:
        super().__init__(console=Console(file=stream, soft_wrap=True), highlighter=None)
        self._worded = worded

    def format(self, record: logging.LogRecord) -> str:
        """The message in its reader's words."""
        return self._worded(super().format(record))

    def render(
        self, *, record: logging.LogRecord, traceback: Traceback | None, message_renderable: ConsoleRenderable
    ) -> ConsoleRenderable:
        """The message alone."""
        return message_renderable


def log_console() -> Console | None:
    """The console that messages go to, so that they appear above a bar; None where they go elsewhere."""
    handlers = logging.getLogger().handlers
    return next((handler.console for handler in handlers if isinstance(handler, RichHandler)), None)
