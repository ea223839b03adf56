"""Comparison of methods over scenes: what is missing is run, what is done is kept."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import get_args

from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.named_files import Variant, variants_of
from coliags_plugin.comparison.plan import ComparisonCell, FailureRecord, make_cells
from coliags_plugin.comparison.scenes import find_scenes, make_phantoms
from coliags_plugin.comparison.worker import CellTask
from coliags_plugin.config.method_config import Method, is_path, method_text
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError, InterruptedRunError, check_name, check_number
from coliags_plugin.core.files import user_path
from coliags_plugin.core.scenes import Scene
from coliags_plugin.core.splits import Split
from coliags_plugin.engine.data_formats import data_manager
from coliags_plugin.engine.progress import progress_callback
from coliags_plugin.engine.task_queue import Job, JobQueue, make_executor
from coliags_plugin.engine.tasks import Ending, ExecutionOptions, Executor
from coliags_plugin.reporting.model import Column, Value
from coliags_plugin.reporting.text_formats import DisplayTable
from coliags_plugin.results.reading import read_result
from coliags_plugin.results.record import SEEN_SUFFIX, Result

log = logging.getLogger(__name__)

#: Methods, names and paths of ablations, and variants; or one of these.
Methods = Method | Variant | Sequence[Method | Variant]


class CellJob(Job):
    """Cells of one result key: the first is run, the others are equal to it."""

    task: CellTask

    def __init__(
        self, cells: Sequence[ComparisonCell], comparison: ComparisonFolder, executor: Executor, device: str
    ) -> None:
        self.cells, self.comparison = cells, comparison
        self.size = sum(cell.steps for cell in cells)
        cell, method, planned = cells[0], cells[0].variant.method, cells[0].planned
        self._run = comparison.run(cell)
        self.task = CellTask(
            title=cell.title,
            key=planned.key,
            folder=self._run.path,
            device=device,
            log=comparison.path / planned.log_file,
            threads=executor.threads,
            name=cell.variant.name,
            method=str(user_path(method).resolve()) if is_path(method) else method,
            overrides=cell.overrides,
            scene=cell.scene.name,
            data=cell.scene.path,
            data_format=cell.scene.data_format,
            seed=cell.seed,
            protocol=cell.protocol,
            result=comparison.path / planned.result,
        )

    def progress(self) -> int:
        """Steps taken; the last one of a cell is over with its evaluation."""
        return min(self._run.logged_step, self.cells[0].steps - 1)

    def finish(self) -> Sequence[Job]:
        """Add the result to all cells that it is of."""
        result = read_result(self.task.result)
        for cell in self.cells:
            self.comparison.add(cell, result)
            log.info("%s: done", cell.title)
        return ()

    def fail(self, reason: str, attempts: int, ending: Ending) -> Sequence[Job]:
        """Record the failure of all cells that wait for the run."""
        for cell in self.cells:
            self.comparison.fail(cell, reason, attempts)
            log.info("%s: failed: %s", cell.title, reason)
        return ()


def run_cells(
    cells: Sequence[ComparisonCell], comparison: ComparisonFolder, executor: Executor, options: ExecutionOptions
) -> None:
    """Complete all cells, whose scenes are there, and add their results and failures to the folder.

    Raises:
        InterruptedRunError: Ctrl-C, or the system's request to end; all runs are saved.
    """
    missing: dict[str, list[ComparisonCell]] = {}
    for cell in cells:
        if (result := comparison.done(cell)) is not None:
            comparison.add(cell, result)
        else:
            missing.setdefault(cell.planned.key, []).append(cell)

    def count_done() -> int:
        return sum(comparison.done(cell) is not None for cell in cells)

    def facts(running: Sequence[Job]) -> str:
        counts = {"running": len(running), "done": count_done(), "failed": len(comparison.failures)}
        counts = {"waiting": len(cells) - sum(counts.values()), **counts}
        return ", ".join(f"{count} {phase}" for phase, count in counts.items() if count)

    jobs = [CellJob(same, comparison, executor, options.device) for same in missing.values()]
    total = sum(cell.steps for cell in cells)
    queue = JobQueue(executor, options.retries, jobs, total, total - sum(job.size for job in jobs))
    try:
        queue.run("compare", facts)
    except KeyboardInterrupt as error:
        raise InterruptedRunError(
            f"stopped with {count_done()} of {len(cells)} cells done; the same command goes on where it stopped"
        ) from error


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
        for name in columns if self.results else ():
            check_name("metric", name, units)
        rows: list[dict[str, Value]] = []
        for name, count in Counter(cell.variant.name for cell in self.cells).items():
            results = [result for result in self.results if name == result.method]
            rows.append({"method": name, "done": f"{len(results)} of {count}"})
            for metric in columns:
                means = [result.mean(metric) for result in results if metric in result.metrics]
                numbers = [mean for mean in means if mean is not None]
                rows[-1][metric] = sum(numbers) / len(numbers) if numbers else None
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


def carry_out(
    methods: Methods, options: CompareOptions, check_data: Callable[[Scene], object] | None = None
) -> FinishedComparison:
    """Train and evaluate methods on scenes, as far as that is not done in the output folder, which is new or extended.

    Every scene with a cell that is missing is given to ``check_data`` before the first run.

    Raises:
        InputError: Something is not valid or not there; nothing was run.
        InterruptedRunError: Ctrl-C; all runs are saved.
    """
    comparison = ComparisonFolder(options.output)
    comparison.check_extends(options)
    cells = plan_cells(methods, options)
    names = ("jobs", "threads", "device", "executor", "ray_address", "retries")
    execution = ExecutionOptions(**{name: getattr(options, name) for name in names})
    executor = make_executor(execution)
    with comparison.held():
        missing = {cell.scene.name: cell for cell in cells if comparison.done(cell) is None}
        if any(not cell.scene.is_there for cell in missing.values()):
            with progress_callback() as progress:
                make_phantoms([cell.scene for cell in missing.values()], progress)
            cells = plan_cells(methods, options)
            missing = {cell.scene.name: cell for cell in cells if comparison.done(cell) is None}
        log.info("%s", _states(cells, comparison).title)
        if missing:
            executor.check(comparison.path, sorted(cell.scene.path for cell in missing.values()))
        if check_data is not None:
            for cell in missing.values():
                with suppress(InputError):  # of which the cell fails
                    check_data(data_manager(cell.config.datamanager, cell.scene.path).load(cell.scene.path))
        comparison.record(options, cells)
        run_cells(cells, comparison, executor, execution)
        results = [(cell.title, result) for cell in cells if (result := comparison.done(cell)) is not None]
    for title, result in results:
        for name, record in result.sets.items():
            if record.blank:
                log.warning("%s, set %s: %s", title, name, record.transparency_warning)
    return FinishedComparison(comparison.path, cells, [result for _, result in results], comparison.failures)


def dry_run(methods: Methods, options: CompareOptions) -> DisplayTable:
    """List what :func:`carry_out` would do with each cell; writes nothing."""
    comparison = ComparisonFolder(options.output)
    comparison.check_extends(options)
    cells = plan_cells(methods, options)
    comparison.read_results()
    return _states(cells, comparison)


def _states(cells: Sequence[ComparisonCell], comparison: ComparisonFolder) -> DisplayTable:
    """Every cell with its state: done, resume, new, same (as an earlier cell), or scene to make."""
    rows: list[dict[str, Value]] = []
    keys: set[str] = set()
    for cell in cells:
        step = 0
        if cell.fingerprint is None:
            state = "scene to make"
        elif comparison.done(cell) is not None:
            state = "done"
        elif cell.planned.key in keys:
            state = "same"
        else:
            keys.add(cell.planned.key)
            step = comparison.run(cell).step
            state = "resume" if step else "new"
        steps = f"{step} of {cell.steps}" if step else str(cell.steps)
        rows.append({"cell": cell.title, "state": state, "steps": steps})
    counts = Counter(row["state"] for row in rows)
    states = ", ".join(f"{count} {state}" for state, count in counts.items())
    columns = [Column("cell"), Column("state", words=True), Column("steps")]
    return DisplayTable(f"{len(cells)} cells: {states}", columns, rows)


def plan_cells(methods: Methods, options: CompareOptions) -> list[ComparisonCell]:
    """The cells that are asked for, after what can be checked without writing anything."""
    methods = [methods] if isinstance(methods, (str, Path, Mapping, Variant)) else methods
    of_methods = [[each] if isinstance(each, Variant) else variants_of(method_text(each)) for each in methods]
    variants = list(chain.from_iterable(of_methods))
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
    if (options.reference is None) == bool(options.primary):
        option, lacking = ("primary", "reference") if options.reference is None else ("reference", "primary")
        raise InputError(f"`{option}` without `{lacking}`", "both: what is decided before the first run")
    if options.reference is not None:
        check_name("method", options.reference, [variant.name for variant in variants])
    protocol = registry.protocols.get(options.protocol)
    metrics = [*protocol.metrics, *protocol.optional_metrics]
    for name in options.primary:
        check_name("metric", name, [*metrics, *(metric + SEEN_SUFFIX for metric in metrics)])
    return make_cells(variants, find_scenes([str(scene) for scene in options.scenes], options.data), options)
