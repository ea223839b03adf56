"""Execution of the cells of a comparison that are not done: retries, failures, and a clean stop."""

from __future__ import annotations

import logging
import os
import shutil
import signal
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from coliags_plugin.comparison.dry_run import RunSizes
from coliags_plugin.comparison.executors import ExecutionOptions, Executor
from coliags_plugin.comparison.folder import ComparisonFolder, FinishedCells
from coliags_plugin.comparison.plan import ComparisonCell
from coliags_plugin.comparison.plan_file import FailureRecord
from coliags_plugin.comparison.tasks import Task, TaskOutcome
from coliags_plugin.config.method_files import is_path
from coliags_plugin.core.errors import InputError, InterruptedRunError
from coliags_plugin.engine.progress import ProgressReport, log_console
from coliags_plugin.reporting.numbers import file_size
from coliags_plugin.results.reading import read_result

log = logging.getLogger(__name__)

_Phase = Literal["waiting", "running", "done", "failed"]

#: Between two reports of progress, seconds.
POLL_INTERVAL_S = 1.0
#: Between lines of progress besides those of the cells, where there is neither a terminal nor a notebook, seconds.
_PLAIN_LINE_EVERY_S = 60.0


class CellQueue:
    """Cells to run, whose scenes are there, those that are running, and what became of the others.

    Of cells with the same result key, one is run; the others are equal to it.
    """

    def __init__(
        self,
        folder: ComparisonFolder,
        executor: Executor,
        options: ExecutionOptions,
        cells: Sequence[ComparisonCell],
        finished: FinishedCells,
        sizes: RunSizes,
    ) -> None:
        self._folder, self._executor, self._options = folder, executor, options
        self._finished, self._sizes = finished, sizes
        self._cells = cells
        self._phases: dict[tuple[str, str, int, str], _Phase] = {cell.identity: "waiting" for cell in cells}
        self._equal: dict[str, list[ComparisonCell]] = {}
        self._attempts: Counter[str] = Counter()
        self._running: dict[str, ComparisonCell] = {}
        self._waiting: deque[ComparisonCell] = deque()
        self._failures: list[FailureRecord] = []
        for cell in cells:
            result = finished.of(cell)
            if result is not None:
                finished.add(cell, result)
                self._phases[cell.identity] = "done"
                continue
            equal = self._equal.setdefault(cell.known_keys.result, [])
            if not equal:
                self._waiting.append(cell)
            equal.append(cell)

    def run(self) -> list[FailureRecord]:
        """Complete all cells, and add their results to the finished ones; returns the failures.

        Raises:
            InterruptedRunError: Ctrl-C, or the system's request to end; all runs are saved.
        """
        total = sum(cell.steps for cell in self._cells)
        with (
            _sigterm_as_interrupt(),
            ProgressReport("compare", total, self._steps, _PLAIN_LINE_EVERY_S, log_console()) as progress,
        ):
            try:
                while self._start_next():
                    progress.update(self._steps, self._counts)
                    self._handle_finished(self._executor.wait(POLL_INTERVAL_S))
                progress.update(self._steps, self._counts)
            except KeyboardInterrupt as error:
                log.info("stopping: the runs are saved; Ctrl-C again to stop at once")
                raise InterruptedRunError(
                    f"stopped with {self._count('done')} of {len(self._cells)} cells done; "
                    "the same command goes on where it stopped"
                ) from error
            finally:
                self._executor.stop()
        return self._failures

    @property
    def _steps(self) -> int:
        """Steps that are over in all cells: all of a failed cell, and the last one of a cell with its evaluation."""
        over = [cell.steps for cell in self._cells if self._phases[cell.identity] in ("done", "failed")]
        running = self._running.values()
        return sum(over) + sum(min(self._folder.run(cell).logged_step, cell.steps - 1) for cell in running)

    @property
    def _counts(self) -> str:
        return ", ".join(f"{count} {phase}" for phase, count in Counter(self._phases.values()).items())

    def _count(self, phase: _Phase) -> int:
        return sum(each == phase for each in self._phases.values())

    def _start_next(self) -> bool:
        """Start what can be started; whether there is anything left to wait for."""
        while self._waiting and len(self._running) < self._executor.slots:
            self._start(self._waiting.popleft())
        return bool(self._running)

    def _handle_finished(self, ended: Sequence[tuple[Task, TaskOutcome]]) -> None:
        """Take the results of workers that have ended; retry or fail the cells of the others."""
        for task, outcome in ended:
            cell = self._running.pop(task.result_key)
            reason, attempts = outcome.reason or outcome.ending, self._attempts[task.result_key]
            if outcome.ending == "done":
                self._complete(cell)
            elif outcome.ending == "failed":
                self._fail(cell, outcome.reason)
            elif attempts > self._options.retries:
                self._fail(cell, f"{reason}, {attempts} times")
            else:
                log.warning("%s: %s; trying again", cell.title, reason)
                self._phases[cell.identity] = "waiting"
                self._waiting.appendleft(cell)

    def _start(self, cell: ComparisonCell) -> None:
        key = cell.known_keys.result
        self._attempts[key] += 1
        needed, free = 2 * self._sizes.of(cell), shutil.disk_usage(self._folder.path).free
        if free < needed:
            self._fail(cell, f"the disk is full: {file_size(free)} left, about {file_size(needed)} needed")
            return
        try:
            self._executor.start(self._task(cell))
        except OSError as error:
            self._fail(cell, f"cannot be started: {error.strerror or error}")
            return
        self._running[key] = cell
        self._set(cell, "running")

    def _task(self, cell: ComparisonCell) -> Task:
        return Task(
            title=cell.title,
            name=cell.variant.name,
            method=str(Path(cell.variant.method).resolve()) if is_path(cell.variant.method) else cell.variant.method,
            overrides=cell.overrides,
            scene=cell.scene.name,
            data=str(cell.scene.path),
            data_format=cell.scene.data_format,
            seed=cell.seed,
            device=self._options.device,
            protocol=cell.protocol,
            run=str(self._folder.run(cell).path),
            result=str(self._folder.result(cell)),
            result_key=cell.known_keys.result,
            log=str(self._folder.log(cell)),
            threads=self._executor.threads,
            variables={name: value for name, value in os.environ.items() if name.startswith("COLIAGS_")},
            save_seconds=self._options.save_seconds,
        )

    def _complete(self, cell: ComparisonCell) -> None:
        try:
            result = read_result(self._folder.result(cell))
            for equal in self._equal[cell.known_keys.result]:
                self._finished.add(equal, result)
                self._set(equal, "done")
        except InputError as error:
            self._fail(cell, str(error))

    def _fail(self, cell: ComparisonCell, reason: str) -> None:
        key = cell.known_keys.result
        for equal in self._equal[key]:
            self._failures.append(self._folder.fail(equal, reason, self._attempts[key]))
            self._set(equal, "failed", f": {reason}")

    def _set(self, cell: ComparisonCell, phase: _Phase, reason: str = "") -> None:
        self._phases[cell.identity] = phase
        ended = self._count("done") + self._count("failed")
        log.info("[%d/%d] %s: %s%s", ended, len(self._cells), cell.title, phase, reason)


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
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
