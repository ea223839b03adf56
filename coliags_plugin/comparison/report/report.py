"""Reports of evaluated runs as HTML, Markdown, LaTeX and CSV."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, get_args

from coliags_plugin.comparison.report.blocks import Content
from coliags_plugin.comparison.report.content import Choices, make_content
from coliags_plugin.comparison.report.frame_values import per_frame_csv
from coliags_plugin.comparison.report.html_report import write_html
from coliags_plugin.comparison.report.latex import latex_report
from coliags_plugin.comparison.report.markdown import markdown_report
from coliags_plugin.comparison.report.sources import read_study
from coliags_plugin.comparison.report.views import Views
from coliags_plugin.core.files import atomic_write
from coliags_plugin.outputs.page import refuse_folder

Format = Literal["html", "markdown", "latex", "csv"]

FORMATS: tuple[Format, ...] = get_args(Format)
SUFFIXES: dict[Format, str] = {"html": ".html", "markdown": ".md", "latex": ".tex", "csv": ".csv"}
_TEXTS: dict[Format, Callable[[Content], str]] = {"markdown": markdown_report, "latex": latex_report}


def write_report(
    paths: Sequence[Path],
    output: Path,
    formats: Sequence[Format] = ("html",),
    choices: Choices | None = None,
    protocol: str = "paper",
    frames: int = 4,
    methods: Sequence[str] = (),
    scene: str = "",
    anonymous: bool = False,
) -> list[Path]:
    """Write a report of methods on scenes: metrics and statistics, views, errors, curves, costs and provenance.

    Args:
        paths: Run folders, results files, and folders of a comparison.
        output: The file to write, replaced if it is there; with several formats, its suffix is that of each.
        formats: What to write. CSV has every metric of every frame.
        choices: Columns, reference, title and note.
        protocol: Name of the evaluation to read from folders.
        frames: Held-out views to show per scene and test set, beside the worst ones.
        methods: Names of methods to show, in this order; empty: all.
        anonymous: Leave out absolute paths that results hold.
        scene: Section with a scene, of the HTML page alone (:mod:`coliags_plugin.comparison.report.scene_section`).

    Returns:
        The files.

    Raises:
        InputError: A result is missing, damaged or not comparable with the others, a choice is not possible, or an
            output cannot be written.
    """
    choices = choices or Choices()
    files = {
        each: output if len(formats) == 1 else output.with_suffix(SUFFIXES[each]) for each in dict.fromkeys(formats)
    }
    for file in files.values():
        refuse_folder(file)
    study = read_study(paths, protocol, methods)
    if anonymous:
        study = study.anonymous()
    content = make_content(study, choices)
    views = Views(study, content.reference, frames) if "html" in files else None
    for each, file in files.items():
        if views is not None and each == "html":
            write_html(study, content, choices, views, file, scene)
        elif each == "csv":
            atomic_write(file, per_frame_csv(study))
        else:
            atomic_write(file, _TEXTS[each](content))
    return [*files.values()]
