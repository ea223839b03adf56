"""Commands on results of evaluations: ``coliags report``, ``coliags results``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class ReportCommand:
    """Compare evaluated methods: tables with statistics, held-out views, errors, curves and costs."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Evaluated run folders, results files (`eval/PROTOCOL/result.json`), or the folder of a `coliags compare`."""
    output: arguments.OptionalOutput = None
    """File to write; with several formats, its suffix is replaced by that of each; default: report.html, .md, ..."""
    methods: arguments.OptionalText = None
    """Names of methods to show, in this order, separated by commas; default: all. Tests count the others too."""
    columns: arguments.OptionalText = None
    """Metrics to show, separated by commas, or `all`; default: psnr,psnr_gain_fitted,ssim,lpips,depth_mse,
    depth_mse_inner,depth_median_error."""
    reference: arguments.OptionalText = None
    """Method that the others are compared with; default: coliags, or the best where it is not there."""
    protocol: str = "paper"
    """Evaluation protocol to read; NAME-truth: evaluations by `coliags eval RUN --truth SCENE`."""
    frames: int = 4
    """Held-out frames to show per scene and test set; the worst ones are added."""
    title: arguments.OptionalText = None
    """Heading; default: methods and scenes."""
    note: arguments.OptionalText = None
    """A remark shown at the top."""
    scene: arguments.OptionalPath = None
    """Run folder whose scene the HTML page lets its reader fly through, offline; needs the extra `viewer`."""
    format: Annotated[
        tuple[Literal["html", "markdown", "latex", "csv", "json", "all"], ...], tyro.conf.UseAppendAction
    ] = ()
    """What to write, repeatable: html (default), markdown, latex (booktabs), csv (every frame), json (tables), all."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Write the report and print the paths."""
        from coliags_plugin.api.comparing import report
        from coliags_plugin.comparison.report.report import FORMATS

        named = tuple(name for name in self.format if name != "all") or FORMATS[:1]
        files = arguments.call(
            report,
            self,
            of=self.paths,
            formats=FORMATS if "all" in self.format else named,
            methods=_listed(self.methods),
            columns=_listed(self.columns),
        )
        print_summary(written=[file.resolve() for file in files], as_json=self.json)


def _listed(text: str | None) -> tuple[str, ...]:
    return tuple(filter(None, (part.strip() for part in (text or "").split(","))))


@dataclass(frozen=True)
class ResultsShowCommand:
    """Show results: what was run, means of the metrics, and what it cost."""

    path: tyro.conf.Positional[Path]
    """Results file, or a run folder, or a folder to search for results files."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Print a table for each."""
        from coliags_plugin.reporting.model import Block, Fact, FactList
        from coliags_plugin.reporting.text_formats import terminal_text
        from coliags_plugin.results.reading import find_results
        from coliags_plugin.results.summaries import facts, means_summary

        blocks: list[Block] = []
        summaries = []
        for result in find_results([self.path]):
            told = facts(result)
            blocks += [result.table(), FactList([Fact(name, text) for name, text in told.items()])]
            summaries.append({**means_summary(result), "facts": told})
        print_summary(terminal_text(blocks), {"results": summaries}, as_json=self.json)


@dataclass(frozen=True)
class ResultsExportCommand:
    """Export results as a long CSV table of every frame's metrics."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Results files, run folders, or folders to search for results files."""
    output: arguments.Output
    """File to write."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Write the table."""
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.results.reading import find_results
        from coliags_plugin.results.tables import write_csv

        if not self.paths:
            raise InputError("no results to export", "at least one file or folder")
        results = find_results(self.paths)
        if self.output.is_dir():
            raise InputError(f"--output {self.output} is a folder", "a file to write, such as table.csv")
        write_csv(self.output, results)
        print_summary(written=[self.output.resolve()], as_json=self.json)


Subcommand = (
    Annotated[ResultsShowCommand, tyro.conf.subcommand("show")]
    | Annotated[ResultsExportCommand, tyro.conf.subcommand("export")]
)


@dataclass(frozen=True)
class ResultsCommand(arguments.CommandGroup):
    """Show results files, and export them as tables."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""
