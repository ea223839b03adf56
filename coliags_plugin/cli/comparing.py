"""Commands on comparisons and results: ``coliags compare``, ``ablate``, ``report``, ``results``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from coliags_plugin.cli.texts import coliags, print_summary
from coliags_plugin.config import options

if TYPE_CHECKING:
    from coliags_plugin.comparison.named_files import Variant


@dataclass(frozen=True, kw_only=True)
class ComparisonCommand(options.CompareOptions):
    """Command that compares."""

    output: options.Output = field()
    dry_run: bool = False
    """Only print what would be done: every cell with its state."""
    json: options.AsJson = False

    def carry_out(self, methods: Sequence[str | Variant]) -> None:
        """Compare and print a summary; exit with status 1 if a cell failed."""
        from coliags_plugin.api.comparing import compare
        from coliags_plugin.comparison.compare import dry_run

        if self.dry_run:
            planned = dry_run(methods, self)
            print_summary(str(planned), {"cells": planned.rows}, as_json=self.json)
            return
        comparison = compare(methods, self)
        table = comparison.table()
        facts = {
            "cells": len(comparison.cells),
            "done": len(comparison.results),
            "failed": [vars(failure) for failure in comparison.failures],
            "methods": table.rows,
        }
        report = [coliags("report", comparison.folder)] if comparison.results else []
        print_summary(str(table), facts, written=[comparison.folder], then=report, as_json=self.json)
        if comparison.failures:
            sys.exit(1)


@dataclass(frozen=True, kw_only=True)
class CompareCommand(ComparisonCommand):
    """Train and evaluate methods on scenes; what is done is kept, and what was interrupted goes on.

    The same command goes on after any interruption. Exit status 1 if a cell failed; the others are done all the same.
    """

    methods: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="METHOD...")]
    """Names of methods (`coliags list methods`) or paths of YAML files."""

    def run(self) -> None:
        """Compare and print a summary."""
        self.carry_out(self.methods)


@dataclass(frozen=True, kw_only=True)
class AblateCommand(ComparisonCommand, options.AblateOptions):
    """Train and evaluate the variants that a file names on scenes; otherwise as compare."""

    file: tyro.conf.Positional[str]
    """Name of an ablation (`coliags list ablations`) or path of a YAML file."""

    def run(self) -> None:
        """Compare the variants and print a summary."""
        from coliags_plugin.comparison.named_files import load_ablation

        self.carry_out(load_ablation(self.file))


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
class ResultsCommand:
    """Show results: what was run, means of the metrics, and what it cost."""

    action: tyro.conf.Positional[Literal["show"]]
    """Action."""
    path: tyro.conf.Positional[Path]
    """Results file, or a run folder, or a folder to search for results files."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print a table for each."""
        from coliags_plugin.reporting.model import Block, Fact, FactList
        from coliags_plugin.reporting.text_formats import terminal_text
        from coliags_plugin.results.reading import facts, find_results

        blocks: list[Block] = []
        summaries = []
        for result in find_results([self.path]):
            texts = facts(result)
            blocks += [result.table(), FactList([Fact(name, text) for name, text in texts.items()])]
            summaries.append({**result.summary(), "facts": texts})
        print_summary(terminal_text(blocks), {"results": summaries}, as_json=self.json)
