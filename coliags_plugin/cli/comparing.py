"""Commands on comparisons: ``coliags compare`` and ``report``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli.texts import coliags, print_summary
from coliags_plugin.config import options

_required = partial(tyro.conf.arg, help_behavior_hint="(required)")


@dataclass(frozen=True, kw_only=True)
class CompareCommand(options.CompareOptions):
    """Train and evaluate methods, or variants of methods, on scenes.

    What is done is kept: the same command goes on after any interruption. Exit status 1 if a cell failed; the others
    are done all the same.
    """

    methods: Annotated[tuple[str, ...], tyro.conf.Positional, _required(metavar="METHOD...")]
    """Methods (`coliags list methods`) and ablations (`coliags list ablations`) by name, and paths of YAML files of a
    method or of variants."""
    dry_run: bool = False
    """Only print what would be done: every cell with its state."""
    json: options.AsJson = False

    def run(self) -> None:
        """Compare and print a summary; exit with status 1 if a cell failed."""
        from coliags_plugin.api.comparing import compare
        from coliags_plugin.comparison.compare import dry_run

        if self.dry_run:
            planned = dry_run(self.methods, self)
            print_summary(str(planned), {"cells": planned.rows}, as_json=self.json)
            return
        comparison = compare(self.methods, self)
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
class ReportCommand(options.ReportOptions):
    """Report on evaluated runs and compare them: tables with statistics, held-out views, errors, curves and costs."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, _required(metavar="PATH...")]
    """Evaluated run folders, results files (`eval/PROTOCOL/result.json`), or the folder of a `coliags compare`."""
    json: options.AsJson = False

    def run(self) -> None:
        """Write the report, and print it as text where asked for, and the paths."""
        from coliags_plugin.api.comparing import report
        from coliags_plugin.results.reading import facts

        written = report(self.paths, self)
        print_summary(
            str(written) if "text" in self.formats else "",
            {"results": [{**result.summary(), "facts": facts(result)} for result in written.results]},
            written=[file.resolve() for file in written.files],
            as_json=self.json,
        )
