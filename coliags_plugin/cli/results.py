"""Commands on results of evaluations: ``coliags report``, ``coliags results``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary
from coliags_plugin.config import options


@dataclass(frozen=True, kw_only=True)
class ReportCommand(options.ReportOptions):
    """Compare evaluated methods: tables with statistics, held-out views, errors, curves and costs."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Evaluated run folders, results files (`eval/PROTOCOL/result.json`), or the folder of a `coliags compare`."""
    json: options.AsJson = False

    def run(self) -> None:
        """Write the report and print the paths."""
        from coliags_plugin.api.comparing import report

        print_summary(written=[file.resolve() for file in report(self.paths, self)], as_json=self.json)


@dataclass(frozen=True)
class ResultsShowCommand:
    """Show results: what was run, means of the metrics, and what it cost."""

    path: tyro.conf.Positional[Path]
    """Results file, or a run folder, or a folder to search for results files."""
    json: options.AsJson = False

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
    output: options.Output
    """File to write."""
    json: options.AsJson = False

    def run(self) -> None:
        """Write the table."""
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.results.reading import find_results
        from coliags_plugin.results.summaries import write_csv

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
