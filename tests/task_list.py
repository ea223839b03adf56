"""Executor without processes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from coliags_plugin.engine.tasks import Executor, Task, TaskOutcome


class TaskList(Executor):
    """Has a subclass work on tasks in this process, one after the other; remembers which."""

    slots, threads = 1, 1

    def __init__(self) -> None:
        self.tasks: list[Task] = []
        self._next: list[Task] = []

    def check(self, folder: Path, inputs: Sequence[Path]) -> None:
        pass

    def start(self, task: Task) -> None:
        self.tasks.append(task)
        self._next.append(task)

    def wait(self, seconds: float) -> list[tuple[Task, TaskOutcome]]:
        ended = [(task, self.outcome(task)) for task in self._next]
        self._next.clear()
        return ended

    def outcome(self, task: Task) -> TaskOutcome:
        raise NotImplementedError

    def stop(self) -> None:
        self._next.clear()
