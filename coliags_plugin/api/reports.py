"""Reports in one call."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from coliags_plugin.api.runs import Run
from coliags_plugin.core.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from coliags_plugin.comparison.compare import FinishedComparison
    from coliags_plugin.comparison.report.report import Format
    from coliags_plugin.reporting.model import Section


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
    from coliags_plugin.comparison.report.page import Choices
    from coliags_plugin.comparison.report.report import SUFFIXES, write_report

    parts = [of] if isinstance(of, (Run, FinishedComparison, str, Path)) else of
    paths = [
        part.path if isinstance(part, Run) else part.folder if isinstance(part, FinishedComparison) else Path(part)
        for part in parts
    ]
    wanted: Sequence[Format] = (formats,) if isinstance(formats, str) else formats
    for each in wanted:
        if each not in SUFFIXES:
            raise InputError(f"no format '{each}'", f"one of {', '.join(SUFFIXES)}", did_you_mean(each, SUFFIXES))
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
