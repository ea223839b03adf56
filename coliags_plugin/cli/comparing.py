"""Commands that compare methods on scenes: ``coliags compare``, ``ablate``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from coliags_plugin.cli.summaries import coliags, print_summary
from coliags_plugin.config import options

if TYPE_CHECKING:
    from coliags_plugin.comparison.named_files import Variant


@dataclass(frozen=True, kw_only=True)
class ComparisonCommand(options.CompareOptions):
    """Command that compares."""

    dry_run: bool = False
    """Only print what would be done: every cell with its state."""
    json: options.AsJson = False

    def carry_out(self, methods: Sequence[str | Variant]) -> None:
        """Compare and print a summary; exit with status 1 if a cell failed."""
        from coliags_plugin.api.comparing import compare
        from coliags_plugin.comparison.compare import dry_run, make_request
        from coliags_plugin.comparison.folder import ComparisonFolder

        if self.dry_run:
            planned = dry_run(make_request(methods, self), ComparisonFolder(self.output))
            print_summary(str(planned), {"cells": planned.rows}, as_json=self.json)
            return
        done = compare(methods, self)
        table = done.table()
        facts = {
            "cells": len(done.cells),
            "done": len(done.results),
            "failed": [vars(failure) for failure in done.failures],
            "methods": table.rows,
        }
        report = [coliags("report", done.folder)] if done.results else []
        print_summary(str(table), facts, written=[done.folder], then=report, as_json=self.json)
        if done.failures:
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
class AblateCommand(ComparisonCommand):
    """Train and evaluate the variants that a file names on scenes; otherwise as compare."""

    file: tyro.conf.Positional[str]
    """Name of an ablation (`coliags list ablations`) or path of a YAML file."""

    def run(self) -> None:
        """Compare the variants and print a summary."""
        from coliags_plugin.comparison.named_files import load_ablation

        self.carry_out(load_ablation(self.file))
