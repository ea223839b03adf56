"""Comparison of methods over scenes: what is missing is run, what is done is kept."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.named_files import Variant
from coliags_plugin.comparison.plan import ComparisonCell, Request, make_cells
from coliags_plugin.comparison.plan_file import FailureRecord
from coliags_plugin.comparison.scenes import find_scenes, make_phantoms
from coliags_plugin.comparison.worker import CellTask
from coliags_plugin.config import registry
from coliags_plugin.config.method_config import method_name
from coliags_plugin.config.method_files import is_path
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.core.errors import InputError, InterruptedRunError, check_name, check_number, did_you_mean
from coliags_plugin.core.files import user_path
from coliags_plugin.datamanagers.scene_settings import Split
from coliags_plugin.engine.progress import progress_callback
from coliags_plugin.engine.task_queue import Job, JobQueue, make_executor
from coliags_plugin.engine.tasks import Ending, ExecutionOptions, Executor
from coliags_plugin.reporting.model import Column, Value
from coliags_plugin.reporting.text_formats import DisplayTable
from coliags_plugin.results.reading import read_result
from coliags_plugin.results.record import SEEN_SUFFIX, Result

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
        self._run, method = runs.folder.run(cell), cell.variant.method
        self.task = CellTask(
            title=cell.title,
            key=cell.known_keys.result,
            name=cell.variant.name,
            method=str(user_path(method).resolve()) if is_path(method) else method,
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
        """Add the result to all cells that it is of."""
        result = read_result(self._runs.folder.result(self._equal[0]))
        for cell in self._equal:
            self._runs.folder.add(cell, result)
            self._runs.end(cell, "done")
        return ()

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """Record the failure of all cells that wait for the run."""
        for cell in self._equal:
            self._runs.failures.append(self._runs.folder.fail(cell, reason, attempts))
            self._runs.end(cell, "failed", f": {reason}")
        return ()


#: Metrics of a summary unless others are chosen.
COLUMNS = ("psnr", "ssim", "depth_mse")


@dataclass(frozen=True)
class FinishedComparison:
    """Results and failures of a comparison."""

    folder: Path  # where its plan, runs and results are
    cells: Sequence[ComparisonCell]  # everything that was asked for
    results: Sequence[Result]  # of the cells that are done, in their order
    failures: Sequence[FailureRecord]  # of those that are not

    def table(self, columns: Sequence[str] = COLUMNS) -> DisplayTable:
        """Mean of metrics over every method's finished cells, of their main test sets, with the reasons of failures.

        Raises:
            InputError: No result has one of the metrics.
        """
        units = {name: metric.unit for result in self.results for name, metric in result.metrics.items()}
        for name in columns:
            if self.results and name not in units:
                raise InputError(f"no metric '{name}'", f"one of {', '.join(units)}", did_you_mean(name, units))
        rows, by_method = [], defaultdict(list)
        for result in self.results:
            by_method[result.method].append(result)
        for method, count in Counter(cell.variant.name for cell in self.cells).items():
            own = by_method[method]
            means = {name: _mean(own, name) for name in columns}
            rows.append({"method": method, "done": f"{len(own)} of {count}", **means})
        return DisplayTable(
            f"{len(self.results)} of {len(self.cells)} cells",
            [Column("method"), Column("done"), *(Column(name, unit=units.get(name, "")) for name in columns)],
            rows,
            [f"failed: {each.scene} {each.method} seed {each.seed}: {each.reason}" for each in self.failures],
        )

    @property
    def runs(self) -> dict[tuple[str, str, int], Path]:
        """Folders of the runs that were begun, by scene, method and seed."""
        folder = ComparisonFolder(self.folder)
        paths = {(cell.scene_label, cell.variant.name, cell.seed): folder.run(cell).path for cell in self.cells}
        return {name: path for name, path in paths.items() if path.is_dir()}

    def __repr__(self) -> str:
        """Number of cells that are done, in one line."""
        failed = f", {len(self.failures)} failed" if self.failures else ""
        return f"{len(self.results)} of {len(self.cells)} cells done{failed}: {self.folder}"

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return self.table()._repr_html_()


def _mean(results: Sequence[Result], metric: str) -> float | None:
    means = [mean for each in results if metric in each.metrics and (mean := each.mean(metric)) is not None]
    return sum(means) / len(means) if means else None


def carry_out(request: Request, folder: ComparisonFolder, options: ExecutionOptions) -> FinishedComparison:
    """Train and evaluate methods on scenes, as far as that is not done in a folder, which is new or extended.

    Raises:
        InputError: Something is not valid or not there; nothing was run.
        InterruptedRunError: Ctrl-C; all runs are saved.
    """
    executor = make_executor(options)
    cells = _plan_cells(request, folder)
    with folder.held():
        missing = {cell.scene.name: cell.scene for cell in cells if folder.done(cell) is None}
        if any(not scene.is_there for scene in missing.values()):
            with progress_callback() as progress:
                make_phantoms(list(missing.values()), progress)
            cells = make_cells(request, folder.recorded_fingerprint)
        log.info("%s", _states(cells, folder).title)
        scenes = {cell.scene.path for cell in cells if folder.done(cell) is None}
        if scenes:
            executor.check(folder.path, sorted(scenes))
        folder.record(request, cells)
        failures = CellRuns(folder, executor, options, cells).run()
        results = [(cell.title, result) for cell in cells if (result := folder.done(cell)) is not None]
    for title, result in results:
        for name, part in result.sets.items():
            if part.blank:
                log.warning("%s, set %s: %s", title, name, part.transparency_warning)
    return FinishedComparison(folder.path, cells, [result for _, result in results], failures)


def dry_run(request: Request, folder: ComparisonFolder) -> DisplayTable:
    """List what :func:`carry_out` would do with each cell; writes nothing."""
    cells = _plan_cells(request, folder)
    folder.read_results()
    return _states(cells, folder)


def _states(cells: Sequence[ComparisonCell], folder: ComparisonFolder) -> DisplayTable:
    """Every cell with its state: done, resume, new, same (as an earlier cell), or scene to make."""
    rows: list[dict[str, Value]] = []
    keys: set[str] = set()
    for cell in cells:
        key, step, changed = "" if cell.keys is None else cell.keys.result, 0, ""
        if folder.done(cell) is not None:
            state = "done"
        elif key in keys:
            state = "same"
        elif not cell.scene.is_there:
            state = "scene to make"
        else:
            step, changed = folder.run(cell).step, folder.changes(cell)
            state = "resume" if step else "new"
        keys |= {key} if key else set()
        steps = f"{step} of {cell.steps}" if step else str(cell.steps)
        rows.append({"cell": cell.title, "state": state, "steps": steps, "changed": changed or None})
    columns = [Column("cell"), Column("state", words=True), Column("steps")]
    if any(row["changed"] for row in rows):
        columns.append(Column("changed", "done before, but changed", words=True))
    counts = Counter(row["state"] for row in rows)
    states = ", ".join(f"{count} {state}" for state, count in counts.items())
    return DisplayTable(f"{len(cells)} cells: {states}", columns, rows)


def _plan_cells(request: Request, folder: ComparisonFolder) -> list[ComparisonCell]:
    """The cells that are asked for, after what can be checked without writing anything."""
    folder.check()
    folder.check_extends(request)
    return make_cells(request, folder.recorded_fingerprint)


def make_request(methods: str | Variant | Sequence[str | Variant], options: CompareOptions) -> Request:
    """Make a request, checked as far as names and numbers go; arguments as in :func:`coliags_plugin.compare`."""
    methods = [methods] if isinstance(methods, (str, Variant)) else methods
    variants = [each if isinstance(each, Variant) else Variant(method_name(each), each) for each in methods]
    if not variants:
        raise InputError("no method", "at least one")
    twice = [name for name, count in Counter(variant.name for variant in variants).items() if count > 1]
    if twice:
        raise InputError(f"more than one method is named {', '.join(twice)}", "methods of different names")
    if not options.scenes:
        raise InputError("no scene", "at least one", "`scenes=phantoms-8` needs no dataset")
    check_number("seeds", options.seeds)
    check_number("steps", options.steps)
    for split in options.splits:
        check_name("split", split, get_args(Split))
    _check_decision([variant.name for variant in variants], options.protocol, options.reference, options.primary)
    return Request(variants, find_scenes([str(scene) for scene in options.scenes], options.data), options)


def _check_decision(methods: Sequence[str], protocol: str, reference: str | None, primary: Sequence[str]) -> None:
    """Refuse a reference without primary metrics, and the reverse, and names that are not there."""
    if (reference is None) == bool(primary):
        given, lacking = ("`primary`", "`reference`") if reference is None else ("`reference`", "`primary`")
        raise InputError(f"{given} without {lacking}", "both: what is decided before the first run")
    if reference is not None:
        check_name("method", reference, methods)
    kind = registry.protocols.get(protocol)
    metrics = [*kind.metrics, *kind.optional_metrics]
    for name in primary:
        check_name("metric", name, [*metrics, *(metric + SEEN_SUFFIX for metric in metrics)])
