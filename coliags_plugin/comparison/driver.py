"""Execution of the cells of a comparison that are not done: retries, failures, and a clean stop."""

from __future__ import annotations

import logging
import os
import shutil
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from coliags_plugin.comparison.cells import Cell, absolute_method
from coliags_plugin.comparison.estimates import Estimates
from coliags_plugin.comparison.executors import Executor
from coliags_plugin.comparison.folder import ComparisonFolder, Failure, Finished
from coliags_plugin.comparison.states import CellState, Watch
from coliags_plugin.comparison.tasks import Outcome, Task
from coliags_plugin.comparison.text import megabytes
from coliags_plugin.core.errors import InputError, InterruptedRunError
from coliags_plugin.results.reading import read_result

log = logging.getLogger(__name__)

#: Between two looks at the progress of the workers, seconds.
_LOOK = 1.0


@dataclass(frozen=True)
class Sweep:
    """How cells are worked on.

    Attributes:
        folder: Where.
        executor: By what.
        device: ``auto``, ``cpu`` or ``cuda``.
        retries: How often a cell whose process died is tried again.
        save_seconds: Largest time between two checkpoints.
    """

    folder: ComparisonFolder
    executor: Executor
    device: str = "auto"
    retries: int = 2
    save_seconds: float = 60.0

    def task(self, cell: Cell) -> Task:
        """What a worker is told of a cell."""
        return Task(
            title=cell.title,
            name=cell.variant.name,
            method=absolute_method(cell.variant.method),
            overrides=cell.overrides,
            scene=cell.scene.name,
            data=str(cell.scene.path),
            data_format=cell.scene.data_format,
            seed=cell.seed,
            device=self.device,
            protocol=cell.protocol,
            run=str(self.folder.run(cell)),
            lock=str(self.folder.lock(cell)),
            result=str(self.folder.result(cell)),
            result_key=cell.known_keys.result,
            log=str(self.folder.log(cell)),
            threads=self.executor.threads,
            variables={name: value for name, value in os.environ.items() if name.startswith("COLIAGS_")},
            save_seconds=self.save_seconds,
        )


def run_cells(
    sweep: Sweep,
    cells: Sequence[Cell],
    finished: Finished,
    estimates: Estimates,
    show: Callable[[Sequence[CellState]], None],
) -> list[Failure]:
    """Complete all cells; one that fails does not keep the others.

    Args:
        sweep: How.
        cells: All cells asked for, whose scenes are there.
        finished: The folder's results, to which those of the cells are added.
        estimates: What a run takes.
        show: Called with the state of every cell whenever one may have changed.

    Returns:
        Why cells failed.

    Raises:
        InterruptedRunError: Ctrl-C, or the system's request to end; all runs are saved.
    """
    watch = Watch(sweep.folder, cells)
    work = _Work(sweep, cells, finished, watch, estimates)
    with _ending_like_interrupt():
        try:
            while work.go_on():
                watch.look()
                show(watch.states)
                work.take(sweep.executor.wait(_LOOK))
            show(watch.states)
        except KeyboardInterrupt as error:
            log.info("stopping: the runs are saved; Ctrl-C again to stop at once")
            sweep.executor.stop()
            done = sum(state.phase == "done" for state in watch.states)
            raise InterruptedRunError(
                f"stopped with {done} of {len(cells)} cells done; the same command goes on where it stopped"
            ) from error
        finally:
            sweep.executor.stop()
    return work.failures


class _Work:
    """The queue of cells, and what became of those that left it."""

    def __init__(
        self, sweep: Sweep, cells: Sequence[Cell], finished: Finished, watch: Watch, estimates: Estimates
    ) -> None:
        self._sweep, self._finished, self._watch, self._estimates = sweep, finished, watch, estimates
        self._same: dict[str, list[Cell]] = {}  # cells by result key: one is run, the others are equal to it
        self._attempts: dict[str, int] = {}
        self._running: dict[str, Cell] = {}
        self._queue: deque[Cell] = deque()
        self.failures: list[Failure] = []
        for cell in cells:
            result = finished.of(cell)
            if result is not None:
                finished.add(cell, result)
                watch.done(cell)
                continue
            equal = self._same.setdefault(cell.known_keys.result, [])
            if not equal:
                self._queue.append(cell)
            equal.append(cell)

    def go_on(self) -> bool:
        """Start what can be started; whether there is anything left to wait for."""
        while self._queue and len(self._running) < self._sweep.executor.slots:
            self._start(self._queue.popleft())
        return bool(self._running)

    def take(self, ended: Sequence[tuple[Task, Outcome]]) -> None:
        """Draw the consequences of workers that have ended."""
        for task, outcome in ended:
            cell = self._running.pop(task.result_key)
            if outcome.ending == "done":
                self._complete(cell)
            elif outcome.ending == "failed":
                self._fail(cell, outcome.reason)
            elif self._attempts[task.result_key] > self._sweep.retries:
                self._fail(cell, f"{outcome.reason or outcome.ending}, {self._attempts[task.result_key]} times")
            else:
                log.warning("%s: %s; trying again", cell.title, outcome.reason or outcome.ending)
                self._watch.waiting(cell)
                self._queue.appendleft(cell)

    def _start(self, cell: Cell) -> None:
        key = cell.known_keys.result
        self._attempts[key] = self._attempts.get(key, 0) + 1
        needed = self._estimates.of(cell).at_times
        free = shutil.disk_usage(self._sweep.folder.path).free
        if free < needed:
            self._fail(cell, f"the disk is full: {megabytes(free)} left, about {megabytes(needed)} needed")
            return
        try:
            self._sweep.executor.start(self._sweep.task(cell))
        except OSError as error:
            self._fail(cell, f"cannot be started: {error.strerror or error}")
            return
        self._running[key] = cell
        self._watch.started(cell)

    def _complete(self, cell: Cell) -> None:
        try:
            result = read_result(self._sweep.folder.result(cell))
            for equal in self._same[cell.known_keys.result]:
                self._finished.add(equal, result)
                self._watch.done(equal)
        except InputError as error:
            self._fail(cell, str(error))

    def _fail(self, cell: Cell, reason: str) -> None:
        attempts = self._attempts[cell.known_keys.result]
        for equal in self._same[cell.known_keys.result]:
            self.failures.append(self._sweep.folder.fail(equal, reason, attempts))
            self._watch.failed(equal, reason)


@contextmanager
def _ending_like_interrupt() -> Iterator[None]:
    """Have the system's request to end (SIGTERM) do as Ctrl-C does."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
