"""``coliags results``: show and export results files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli.arguments import AsJson, Output
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class ResultsShowCommand:
    """Show results: what was run, means of the metrics, and what it cost."""

    path: tyro.conf.Positional[Path]
    """Results file, or a run folder, or a folder to search for results files."""
    json: AsJson = False

    def run(self) -> None:
        """Print a table for each."""
        from coliags_plugin.results.reading import find_results
        from coliags_plugin.results.summaries import facts, means_summary

        results = find_results([self.path])
        texts = [
            "\n".join([str(result), *(f"{name:<16}{text}" for name, text in facts(result).items())])
            for result in results
        ]
        summaries = {"results": [{**means_summary(result), "facts": facts(result)} for result in results]}
        print_summary("\n".join(texts), summaries, as_json=self.json)


@dataclass(frozen=True)
class ResultsExportCommand:
    """Export results as a long table of every frame's metrics, or in the form of nerfbaselines' results files."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Results files, run folders, or folders to search for results files."""
    output: Output
    """File to write; for nerfbaselines a folder."""
    format: Literal["csv", "parquet", "nerfbaselines"] = "csv"
    """Form; parquet needs the extra `tables`."""
    json: AsJson = False

    def run(self) -> None:
        """Write the files."""
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.results.nerfbaselines import write_nerfbaselines
        from coliags_plugin.results.reading import find_results
        from coliags_plugin.results.tables import write_csv, write_parquet

        if not self.paths:
            raise InputError("no results to export", "at least one file or folder")
        results = find_results(self.paths)
        if self.format == "nerfbaselines":
            files = write_nerfbaselines(self.output, results)
        else:
            if self.output.is_dir():
                raise InputError(f"--output {self.output} is a folder", f"a file to write, such as table.{self.format}")
            write = write_csv if self.format == "csv" else write_parquet
            write(self.output, results)
            files = [self.output]
        print_summary(written=[file.resolve() for file in files], as_json=self.json)


Subcommand = (
    Annotated[ResultsShowCommand, tyro.conf.subcommand("show")]
    | Annotated[ResultsExportCommand, tyro.conf.subcommand("export")]
)


@dataclass(frozen=True)
class ResultsCommand:
    """Show results files, and export them as tables."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
