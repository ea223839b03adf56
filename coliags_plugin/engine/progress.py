"""Progress reports: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

#: Between plain lines, seconds.
PLAIN_LINE_EVERY = 10.0


class ProgressReport:
    """Progress towards a total, with facts and the remaining time.

    Use as a context manager; call :meth:`update` as often as you like.

    Args:
        title: What is being done.
        total: Where the count ends.
        start: Where it begins.
    """

    def __init__(self, title: str, total: int, start: int = 0) -> None:
        self.title = title
        self.total = total
        self.first = start
        self.console = Console(file=sys.stderr)
        self.bar: Progress | None = None
        self.task: Any = None
        self.began = self.last_line = time.monotonic()

    def __enter__(self) -> ProgressReport:
        self.began = self.last_line = time.monotonic()
        if self.console.is_terminal:
            columns = [
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[facts]}"),
            ]
            self.bar = Progress(*columns, console=self.console)
            self.bar.start()
            self.task = self.bar.add_task(self.title, total=self.total, completed=self.first, facts="")
        return self

    def update(self, done: int, facts: str = "") -> None:
        """Report ``done`` of the total, with ``facts`` behind the bar."""
        if self.bar is not None:
            self.bar.update(self.task, completed=done, facts=facts)
            return
        now = time.monotonic()
        if now - self.last_line >= PLAIN_LINE_EVERY or done == self.total:
            self.last_line = now
            left = (now - self.began) / max(1, done - self.first) * (self.total - done)
            self.console.print(f"{self.title} {done}/{self.total}, {left:.0f} s to go  {facts}", highlight=False)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar is not None:
            self.bar.stop()


@contextmanager
def progress_callback(after: float = 0.0) -> Iterator[Callable[[str, int, int], None]]:
    """A function ``(title, done, total)`` that shows one report per title, one after the other.

    Args:
        after: Say nothing about what takes less than so many seconds.
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
