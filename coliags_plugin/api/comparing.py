"""Comparison of methods over scenes, and reports, each in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.api.runs import Run
from coliags_plugin.config.assignments import assignments
from coliags_plugin.core.errors import check_name

if TYPE_CHECKING:
    from coliags_plugin.comparison.compare import FinishedComparison
    from coliags_plugin.comparison.named_files import Variant
    from coliags_plugin.comparison.report.report import Format
    from coliags_plugin.reporting.model import Section


def compare(
    methods: str | Variant | Sequence[str | Variant],
    scenes: str | Path | Sequence[str | Path],
    output: str | Path = "comparison",
    *,
    data: str | Path | None = None,
    seeds: int = 1,
    protocol: str = "paper",
    splits: Sequence[str] = (),
    steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    reference: str | None = None,
    primary: Sequence[str] = (),
    jobs: int | None = None,
    threads: int | None = None,
    device: str = "auto",
    executor: str = "local",
    ray_address: str | None = None,
    retries: int = 2,
) -> FinishedComparison:
    """Train and evaluate methods on scenes: what is missing is run, what is done is kept.

    Args:
        methods: Names of methods, paths of method configs, or variants (:func:`variant`).
        scenes: Benchmarks, ``BENCHMARK/SCENE``, paths of benchmark files, or folders of scenes.
        output: Folder of the comparison; one that is there is extended.
        data: Folder of the benchmark's scenes; None: ``scenes/BENCHMARK``.
        seeds: Runs of every method on every scene, with the seeds 0, 1, ...
        protocol: Name of the evaluation protocol.
        splits: Splits, each trained apart; empty: each scene's own.
        steps: Training steps of all runs; None: each method's own.
        settings: Changes of all method configs, see :func:`~coliags_plugin.api.training.train`.
        reference: Reference method of the tests in reports, fixed before the first run; only for a new folder.
        primary: Metrics fixed likewise; in reports, p-values of others are exploratory and have no stars.
        jobs: Runs at a time; None: one per CPU, or per GPU.
        threads: CPU threads of each run; None: the CPUs divided by the runs at a time.
        device: ``auto``, ``cpu``, ``cuda`` (the first CUDA device) or ``cuda:N``.
        executor: Where runs are processes: ``local``, or ``ray`` for a Ray cluster.
        ray_address: ``HOST:PORT`` of the cluster's head; None: ``RAY_ADDRESS``, or the cluster of this machine.
        retries: How often a run is resumed whose process was killed or crashed.

    Raises:
        InputError: Methods, scenes or options are not valid or not there, or the folder cannot be used; nothing was
            run.
        InterruptedRunError: Ctrl-C; all runs are saved, and the same call goes on with them.
    """
    from coliags_plugin.comparison.compare import carry_out, make_request
    from coliags_plugin.comparison.folder import ComparisonFolder
    from coliags_plugin.comparison.named_files import Variant
    from coliags_plugin.execution.executors import ExecutionOptions

    methods = [methods] if isinstance(methods, (str, Variant)) else methods
    scenes = [scenes] if isinstance(scenes, (str, Path)) else scenes
    changes = assignments(settings)
    request = make_request(methods, scenes, data, seeds, protocol, splits, steps, changes, reference, primary)
    options = ExecutionOptions(jobs, threads, device, executor, ray_address, retries)
    return carry_out(request, ComparisonFolder(Path(output)), options)


def ablate(
    file: str | Path, scenes: str | Path | Sequence[str | Path], output: str | Path = "ablation", **options: Any
) -> FinishedComparison:
    """Compare the variants of methods that a file names.

    Args:
        file: Name of an ablation, or path of a YAML file.
        scenes: See :func:`compare`.
        output: See :func:`compare`.
        options: See :func:`compare`.

    Raises:
        InputError: See :func:`compare`; or there is no such file, or it is not valid.
        InterruptedRunError: See :func:`compare`.
    """
    from coliags_plugin.comparison.named_files import load_ablation

    return compare(load_ablation(str(file)), scenes, output, **options)


def variant(name: str, method: str, settings: Mapping[str, Any]) -> Variant:
    """A method with changes, under a name of its own.

    Args:
        name: In tables and file names.
        method: Name of a method or path of a method config.
        settings: Changes of the method config, see :func:`~coliags_plugin.api.training.train`.

    Raises:
        InputError: These are no settings.
    """
    from coliags_plugin.comparison.named_files import Variant

    return Variant(name, method, assignments(settings))


def report(
    of: Run | FinishedComparison | str | Path | Sequence[Run | FinishedComparison | str | Path],
    output: str | Path | None = None,
    *,
    formats: Format | Sequence[Format] = "html",
    methods: Sequence[str] = (),
    columns: Sequence[str] = (),
    reference: str | None = None,
    protocol: str = "paper",
    frames: int = 4,
    title: str | None = None,
    note: str | None = None,
    scene: Run | str | Path | None = None,
) -> list[Path]:
    """Write a report of evaluated methods: tables with statistics, held-out views, errors, curves and costs.

    Args:
        of: Runs, comparisons, or paths of run folders, results files and folders of comparisons.
        output: File to write; with several formats, its suffix is that of each. None: ``report.html``, ``.md``, ...
        formats: ``html``, ``markdown``, ``latex``, ``csv`` with every metric of every frame, ``json`` with the tables.
        methods: Names of methods to show, in this order; empty: all.
        columns: Metrics to show; empty: the default ones.
        reference: Method that the others are compared with; None: ``coliags``, or the best where it is not there.
        protocol: Evaluation protocol to read.
        frames: Held-out frames to show per scene and test set; the worst ones are added.
        title: Heading; None: methods and scenes.
        note: A remark shown at the top.
        scene: A run whose scene the HTML page lets its reader fly through, at most 5 MB more (docs/viewer.md 3).

    Returns:
        The files.

    Raises:
        InputError: A result is missing, damaged or not comparable with the others, a choice is not possible, or a file
            cannot be written.
    """
    from coliags_plugin.comparison.compare import FinishedComparison
    from coliags_plugin.comparison.report.report import SUFFIXES, Choices, write_report

    parts = [of] if isinstance(of, (Run, FinishedComparison, str, Path)) else of
    paths = [
        part.path if isinstance(part, Run) else part.folder if isinstance(part, FinishedComparison) else Path(part)
        for part in parts
    ]
    wanted: Sequence[Format] = (formats,) if isinstance(formats, str) else formats
    for each in wanted:
        check_name("format", each, SUFFIXES)
    file = Path(f"report{SUFFIXES[wanted[0]]}") if output is None else Path(output)
    section = _scene_section(scene) if scene is not None and "html" in wanted else None
    choices = Choices(columns, reference, title, note, frames)
    return write_report(paths, file, wanted, choices, protocol, methods, section)


def _scene_section(of: Run | str | Path) -> Section:
    from coliags_plugin.export.viewer.saving import scene_page
    from coliags_plugin.reporting.model import Section, Template

    run = of if isinstance(of, Run) else Run(of)
    values = {"page": scene_page(run.load()).html, "name": f"{run.method} on {run.scene_name}, seed {run.seed}"}
    return Section("Scene", [Template("scene.html", values)], screen_only=True)
