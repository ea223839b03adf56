"""Reports of evaluated runs as HTML, Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from coliags_plugin.comparison.report.page import Choices, per_frame_csv, screen_page, text_page
from coliags_plugin.comparison.report.sources import read_study
from coliags_plugin.core.files import atomic_write, write_json
from coliags_plugin.reporting.html_page import refuse_folder, write_html
from coliags_plugin.reporting.json_values import page_values
from coliags_plugin.reporting.model import Section
from coliags_plugin.reporting.text_formats import latex_text, markdown_text

Format = Literal["html", "markdown", "latex", "csv", "json"]

FORMATS: tuple[Format, ...] = get_args(Format)
SUFFIXES: dict[Format, str] = {"html": ".html", "markdown": ".md", "latex": ".tex", "csv": ".csv", "json": ".json"}


def write_report(
    paths: Sequence[Path],  # run folders, results files, and folders of a comparison
    output: Path,
    formats: Sequence[Format] = ("html",),
    choices: Choices | None = None,
    protocol: str = "paper",  # name of the evaluation to read from folders
    methods: Sequence[str] = (),  # to show, in this order; empty: all
    scene: Section | None = None,  # a scene to fly through, of the HTML page alone
) -> list[Path]:
    """Write a report of methods on scenes: metrics and statistics, views, errors, curves, costs and provenance.

    Returns the files: the output, replaced if it is there, or that with the suffix of each of several formats. CSV has
    every metric of every frame, JSON the tables.
    """
    choices = choices or Choices()
    files = {
        each: output if len(formats) == 1 else output.with_suffix(SUFFIXES[each]) for each in dict.fromkeys(formats)
    }
    for file in files.values():
        refuse_folder(file)
    study = read_study(paths, protocol, methods)
    text = text_page(study, choices)
    screen = screen_page(text, study, choices, scene) if "html" in files else text
    for each, file in files.items():
        if each == "html":
            write_html(screen, file)
        elif each == "csv":
            atomic_write(file, per_frame_csv(study))
        elif each == "json":
            write_json(file, page_values(text))
        else:
            atomic_write(file, latex_text(text) if each == "latex" else markdown_text(text))
    return [*files.values()]
