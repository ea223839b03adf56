"""Execution of the cells of a comparison that are not done."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.plan import ComparisonCell
from coliags_plugin.comparison.plan_file import FailureRecord
from coliags_plugin.comparison.worker import CellTask
from coliags_plugin.config.method_files import is_path
from coliags_plugin.core.errors import InterruptedRunError
from coliags_plugin.execution.executors import ExecutionOptions, Executor
from coliags_plugin.execution.queue import Job, JobQueue
from coliags_plugin.execution.tasks import Ending
from coliags_plugin.results.reading import read_result

log = logging.getLogger(__name__)


class CellRuns:
    """Cells to run, whose scenes are there, and what became of them.

    Of cells with the same result key, one is run; the others are equal to it.
    """

    def __init__(
        self,
        folder: ComparisonFolder,
        executor: Executor,
        options: ExecutionOptions,
        cells: Sequence[ComparisonCell],
    ) -> None:
        self.folder, self.executor, self.options = folder, executor, options
        self.failures, self._count = list[FailureRecord](), len(cells)
        self._ended = {"done": 0, "failed": 0}
        equal: dict[str, list[ComparisonCell]] = {}
        for cell in cells:
            if (result := folder.done(cell)) is not None:
                folder.add(cell, result)
                self._ended["done"] += 1
            else:
                equal.setdefault(cell.known_keys.result, []).append(cell)
        jobs = [CellJob(same, self) for same in equal.values()]
        total = sum(cell.steps for cell in cells)
        self._queue = JobQueue(executor, options.retries, jobs, total, total - sum(job.size for job in jobs))

    def run(self) -> list[FailureRecord]:
        """Complete all cells, and add their results to the folder; returns the failures.

        Raises:
            InterruptedRunError: Ctrl-C, or the system's request to end; all runs are saved.
        """
        try:
            self._queue.run("compare", self._told)
        except KeyboardInterrupt as error:
            raise InterruptedRunError(
                f"stopped with {self._ended['done']} of {self._count} cells done; "
                "the same command goes on where it stopped"
            ) from error
        return self.failures

    def end(self, cell: ComparisonCell, how: str, reason: str = "") -> None:
        """Count a cell that is ``done`` or has ``failed``, and tell so."""
        self._ended[how] += 1
        log.info("[%d/%d] %s: %s%s", sum(self._ended.values()), self._count, cell.title, how, reason)

    def _told(self, running: Sequence[Job]) -> str:
        waiting = self._count - len(running) - sum(self._ended.values())
        counts = {"waiting": waiting, "running": len(running), **self._ended}
        return ", ".join(f"{count} {phase}" for phase, count in counts.items() if count)


class CellJob(Job):
    """Cells of one result key: the first is run, the others are equal to it."""

    def __init__(self, equal: Sequence[ComparisonCell], runs: CellRuns) -> None:
        self._equal, self._runs, cell = equal, runs, equal[0]
        self.size = sum(cell.steps for cell in equal)
        self._run = runs.folder.run(cell)
        self.task = CellTask(
            title=cell.title,
            key=cell.known_keys.result,
            name=cell.variant.name,
            method=str(Path(cell.variant.method).resolve()) if is_path(cell.variant.method) else cell.variant.method,
            overrides=cell.overrides,
            scene=cell.scene.name,
            data=str(cell.scene.path),
            data_format=cell.scene.data_format,
            seed=cell.seed,
            device=runs.options.device,
            protocol=cell.protocol,
            run=str(self._run.path),
            result=str(runs.folder.result(cell)),
            log=str(runs.folder.log(cell)),
            threads=runs.executor.threads,
            save_seconds=runs.options.save_seconds,
        )

    def progress(self) -> int:
        """Steps taken; the last one of a cell is over with its evaluation."""
        return min(self._run.logged_step, self._equal[0].steps - 1)

    def finish(self) -> Sequence[Job]:
        """See :class:`Job`."""
        result = read_result(self._runs.folder.result(self._equal[0]))
        for cell in self._equal:
            self._runs.folder.add(cell, result)
            self._runs.end(cell, "done")
        return ()

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """See :class:`Job`."""
        for cell in self._equal:
            self._runs.failures.append(self._runs.folder.fail(cell, reason, attempts))
            self._runs.end(cell, "failed", f": {reason}")
        return ()
