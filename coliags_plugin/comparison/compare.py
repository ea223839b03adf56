"""Comparison of methods over scenes in one call."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from coliags_plugin.comparison.cells import Cell, Variant
from coliags_plugin.comparison.driver import Sweep, run_cells
from coliags_plugin.comparison.estimates import Estimates
from coliags_plugin.comparison.executors import Executor, LocalExecutor
from coliags_plugin.comparison.folder import ComparisonFolder, Failure
from coliags_plugin.comparison.live import live_report
from coliags_plugin.comparison.plan import Request, make_cells
from coliags_plugin.comparison.preview import Preview, preview
from coliags_plugin.comparison.ray_executor import RayExecutor
from coliags_plugin.comparison.scenes import SceneSource, find_scenes, make_phantoms
from coliags_plugin.comparison.summary import COLUMNS, summary_table
from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.datamanagers.splits import Split
from coliags_plugin.engine.devices import choose_device
from coliags_plugin.engine.progress import progress_callback
from coliags_plugin.results.display import Table
from coliags_plugin.results.record import Result

log = logging.getLogger(__name__)

ExecutorName = Literal["local", "ray"]


@dataclass(frozen=True)
class Comparison:
    """What a comparison came to.

    Attributes:
        folder: Where its plan, runs and results are.
        cells: Everything that was asked for.
        results: Of the cells that are done, in their order.
        failures: Of those that are not.
    """

    folder: Path
    cells: Sequence[Cell]
    results: Sequence[Result]
    failures: Sequence[Failure]

    def table(self, columns: Sequence[str] = COLUMNS) -> Table:
        """Mean of every method over its finished cells, with the reasons of failures.

        Args:
            columns: Names of metrics.

        Raises:
            InputError: No result has one of the metrics.
        """
        return summary_table(self.cells, self.results, self.failures, columns)

    @property
    def runs(self) -> dict[tuple[str, str, int], Path]:
        """Folders of the runs that were begun, by scene, method and seed."""
        folder = ComparisonFolder(self.folder)
        places = {(cell.scene_label, cell.variant.name, cell.seed): folder.run(cell) for cell in self.cells}
        return {name: place for name, place in places.items() if place.is_dir()}

    def __repr__(self) -> str:
        """How much is done, in one line."""
        failed = f", {len(self.failures)} failed" if self.failures else ""
        return f"{len(self.results)} of {len(self.cells)} cells done{failed}: {self.folder}"

    def _repr_html_(self) -> str:
        """The table, for notebooks."""
        return self.table()._repr_html_()


@dataclass(frozen=True)
class How:
    """How a comparison is carried out.

    Attributes:
        jobs: Runs at a time; None: one per CPU, or per GPU.
        threads: CPU threads of each; None: the CPUs divided by the runs at a time.
        device: ``auto``, ``cpu`` or ``cuda``.
        executor: ``local`` or ``ray``.
        ray_address: ``HOST:PORT`` of the cluster's head; None: ``RAY_ADDRESS``, or the cluster of this machine.
        retries: How often a cell whose process died is tried again.
        save_seconds: Largest time between two checkpoints of a run.
    """

    jobs: int | None = None
    threads: int | None = None
    device: str = "auto"
    executor: str = "local"
    ray_address: str | None = None
    retries: int = 2
    save_seconds: float = 60.0


def compare(
    methods: Sequence[str | Variant],
    scenes: Sequence[str | Path],
    output: str | Path,
    *,
    data: str | Path | None = None,
    seeds: int = 1,
    protocol: str = "paper",
    splits: Sequence[str] = (),
    steps: int | None = None,
    overrides: Sequence[str] = (),
    how: How | None = None,
) -> Comparison:
    """Train and evaluate methods on scenes: what is missing is run, what is done is kept.

    Args:
        methods: Names of methods, paths of method configs, or variants of methods.
        scenes: Benchmarks, ``BENCHMARK/SCENE``, paths of benchmark files, or folders of scenes.
        output: Folder of the comparison, new or with another that this one extends.
        data: Folder of the benchmark's scenes; None: ``scenes/BENCHMARK``.
        seeds: Runs of every cell, with the seeds 0, 1, ...
        protocol: Name of the evaluation protocol.
        splits: Splits, each a cell of its own; empty: each scene's own.
        steps: Length of all runs; None: each method's own.
        overrides: ``key.path=value`` changes of all methods.
        how: How to carry it out.

    Raises:
        InputError: Methods, scenes or options are not valid or not there, the folder cannot be used, or the disk is
            too small; nothing was run.
        InterruptedRunError: Ctrl-C; all runs are saved.
    """
    how = how or How()
    request = make_request(methods, scenes, data, seeds, protocol, splits, steps, overrides)
    return carry_out(request, ComparisonFolder(Path(output)), make_executor(how), how)


def carry_out(request: Request, folder: ComparisonFolder, executor: Executor, how: How) -> Comparison:
    """Run what is missing.

    Args:
        request: What is asked for.
        folder: Where.
        executor: Where workers run.
        how: The other options.

    Raises:
        InputError: See :func:`compare`.
        InterruptedRunError: See :func:`compare`.
    """
    cells = plan_cells(request, folder)
    with folder.held():
        finished = folder.finished()
        missing = {cell.scene.name: cell.scene for cell in cells if finished.of(cell) is None}
        if any(not scene.is_there for scene in missing.values()):
            with progress_callback() as progress:
                make_phantoms(list(missing.values()), progress)
            cells = make_cells(request, folder.recorded_fingerprint)
        estimates = Estimates(folder, finished.results)
        ahead = preview(cells, folder, finished, estimates, executor.slots)
        log.info("%s", ahead.line())
        ahead.check_disk()
        left = {cell.scene.path for cell in cells if finished.of(cell) is None}
        if left:
            executor.check(folder.path, sorted(left))
        folder.record(request, cells)
        sweep = Sweep(folder, executor, how.device, how.retries, how.save_seconds)
        with live_report() as show:
            failures = run_cells(sweep, cells, finished, estimates, show)
        results = [result for cell in cells if (result := finished.of(cell)) is not None]
    return Comparison(folder.path, cells, results, failures)


def dry_run(request: Request, folder: ComparisonFolder, executor: Executor) -> Preview:
    """What :func:`carry_out` would do; writes nothing.

    Raises:
        InputError: See :func:`compare`.
    """
    cells = plan_cells(request, folder)
    finished = folder.finished()
    return preview(cells, folder, finished, Estimates(folder, finished.results), executor.slots)


def plan_cells(request: Request, folder: ComparisonFolder) -> list[Cell]:
    """The cells that are asked for, after what can be checked without writing anything.

    Raises:
        InputError: A method, split or change is not valid, or the folder is of something else.
    """
    folder.check()
    folder.check_extends(request)
    return make_cells(request, folder.recorded_fingerprint)


def make_request(
    methods: Sequence[str | Variant],
    scenes: Sequence[str | Path],
    data: str | Path | None,
    seeds: int,
    protocol: str,
    splits: Sequence[str],
    steps: int | None,
    overrides: Sequence[str],
) -> Request:
    """What is asked for, checked as far as names and numbers go; see :func:`compare`.

    Raises:
        InputError: A name is unknown or there twice, or a number is not valid.
    """
    variants = [each if isinstance(each, Variant) else Variant(method_name(each), each) for each in methods]
    if not variants:
        raise InputError("no method", "at least one")
    twice = [name for name, count in Counter(variant.name for variant in variants).items() if count > 1]
    if twice:
        raise InputError(f"more than one method is named {', '.join(twice)}", "methods of different names")
    if not scenes:
        raise InputError("no scene", "at least one", "--scenes phantoms-8 needs no dataset")
    if seeds < 1:
        raise InputError(f"--seeds {seeds}", "at least 1")
    if steps is not None and steps < 1:
        raise InputError(f"--steps {steps}", "at least 1")
    for split in splits:
        if split not in get_args(Split):
            known = ", ".join(get_args(Split))
            raise InputError(f"no split '{split}'", f"one of {known}", did_you_mean(split, get_args(Split)))
    found: list[SceneSource] = find_scenes([str(scene) for scene in scenes], None if data is None else Path(data))
    return Request(variants, found, range(seeds), protocol, tuple(dict.fromkeys(splits)), steps, tuple(overrides))


def make_executor(how: How) -> Executor:
    """The executor of a comparison.

    Raises:
        InputError: An option is not valid, or the executor cannot be used.
    """
    for name, number in (("jobs", how.jobs), ("threads", how.threads)):
        if number is not None and number < 1:
            raise InputError(f"--{name} {number}", "at least 1")
    if how.retries < 0:
        raise InputError(f"--retries {how.retries}", "0 or more")
    if how.executor not in get_args(ExecutorName):
        known = get_args(ExecutorName)
        raise InputError(
            f"no executor '{how.executor}'", f"one of {', '.join(known)}", did_you_mean(how.executor, known)
        )
    if how.executor == "ray":
        return RayExecutor(how.ray_address, how.jobs, how.threads or 1, how.device)
    cpus = len(os.sched_getaffinity(0))
    gpus = _gpus(how.device)
    jobs = how.jobs or len(gpus) or cpus
    return LocalExecutor(jobs, how.threads or max(1, cpus // jobs), gpus)


def _gpus(device: str) -> list[str]:
    """Identifiers of the GPUs to use, as in ``CUDA_VISIBLE_DEVICES``."""
    import torch

    if choose_device(device).type != "cuda":
        return []
    visible = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
    return visible or [str(number) for number in range(torch.cuda.device_count())]
