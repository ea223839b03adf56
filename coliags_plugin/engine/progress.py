"""Progress reports of long jobs."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType

from rich.console import Console
from rich.logging import RichHandler

from coliags_plugin.engine.progress_displays import PLAIN_LINE_EVERY, Display, open_display


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
        self._total, self._start, self._plain_every, self._console = total, start, plain_every, console
        self._display: Display | None = None

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
