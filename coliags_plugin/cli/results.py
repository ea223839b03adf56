"""``coliags results``: show and export results files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Show:
    """Show results: what was run, means of the metrics, and what it cost."""

    path: tyro.conf.Positional[Path]
    """Results file, or a run folder, or a folder to search for results files."""

    def run(self) -> None:
        """Print a table for each."""
        from coliags_plugin.results.finding import find_results
        from coliags_plugin.results.summaries import facts

        for result in find_results([self.path]):
            print(result)
            for name, text in facts(result).items():
                print(f"{name:<16}{text}")


@dataclass(frozen=True)
class Export:
    """Export results as a long table of every frame's metrics, or in the form of nerfbaselines' results files."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Results files, run folders, or folders to search for results files."""
    output: Path
    """File to write; for nerfbaselines a folder."""
    format: Literal["csv", "parquet", "nerfbaselines"] = "csv"
    """Form; parquet needs the extra `tables`."""

    def run(self) -> None:
        """Write the files and print their paths."""
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.results.finding import find_results
        from coliags_plugin.results.nerfbaselines import write_nerfbaselines
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
        for file in files:
            print(file.resolve())


Subcommand = Annotated[Show, tyro.conf.subcommand("show")] | Annotated[Export, tyro.conf.subcommand("export")]


@dataclass(frozen=True)
class Results:
    """Show results files, and export them as tables."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
