"""Comparison of methods over scenes, and reports, each in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coliags_plugin.api.runs import Run, warn_of_suspect_data
from coliags_plugin.config.method_config import Method, method_text
from coliags_plugin.config.options import CompareOptions, ReportOptions, takes
from coliags_plugin.config.yaml_tree import assignments
from coliags_plugin.core.files import user_path

if TYPE_CHECKING:
    from coliags_plugin.comparison.compare import FinishedComparison, Methods
    from coliags_plugin.comparison.named_files import Variant
    from coliags_plugin.comparison.report.report import WrittenReport
    from coliags_plugin.reporting.model import Section


@takes(CompareOptions)
def compare(methods: Methods, options: CompareOptions) -> FinishedComparison:
    """Train and evaluate methods on scenes: what is missing is run, what is done is kept.

    Images, poses and depth of a scene that contradict each other, as far as that is quickly seen, are warned of before
    the first run.

    Args:
        methods: Names of methods or ablations, paths of method configs or files of variants, mappings like a config, or
            variants (:func:`variant`).
        options: See below.

    Raises:
        InputError: Methods, scenes or options are not valid or not there, or the folder cannot be used; nothing was
            run.
        InterruptedRunError: Ctrl-C; all runs are saved, and the same call goes on with them.
    """
    from coliags_plugin.comparison.compare import carry_out

    return carry_out(methods, options, warn_of_suspect_data)


def variant(name: str, method: Method, settings: Mapping[str, Any]) -> Variant:
    """A method with changes, under a name of its own.

    Args:
        name: In tables and file names.
        method: Name of a method, or path or mapping of a method config.
        settings: Changes of the method config, see :func:`~coliags_plugin.api.runs.train`.

    Raises:
        InputError: These are no settings.
    """
    from coliags_plugin.comparison.named_files import Variant

    return Variant(name, method_text(method), assignments(settings))


@takes(ReportOptions)
def report(
    of: Run | FinishedComparison | str | Path | Sequence[Run | FinishedComparison | str | Path], options: ReportOptions
) -> WrittenReport:
    """Write a report of evaluated methods: tables with statistics, held-out views, errors, curves and costs.

    Args:
        of: Runs, comparisons, or paths of run folders, results files and folders of comparisons.
        options: See below.

    Returns:
        The ``files``, and the ``results`` that they are of; ``print`` shows it as text, without figures.

    Raises:
        InputError: A result is missing, damaged or not comparable with the others, a choice is not possible, or a file
            exists or cannot be written.
    """
    from coliags_plugin.comparison.compare import FinishedComparison
    from coliags_plugin.comparison.report.report import write_report

    parts = [of] if isinstance(of, (Run, FinishedComparison, str, Path)) else of
    paths = [
        part.path if isinstance(part, Run) else part.folder if isinstance(part, FinishedComparison) else user_path(part)
        for part in parts
    ]
    is_html = not {"html", "all"}.isdisjoint(options.formats)
    return write_report(paths, options, _scene_section(options.scene) if options.scene and is_html else None)


def _scene_section(of: Run | str | Path) -> Section:
    from coliags_plugin.export.viewer.page import scene_page
    from coliags_plugin.reporting.model import Section, Template

    run = of if isinstance(of, Run) else Run(of)
    values = {"page": scene_page(run.load()).html, "name": f"{run.method} on {run.scene_name}, seed {run.seed}"}
    return Section("Scene", [Template("scene.html", values)], screen_only=True)
