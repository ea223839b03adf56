"""Commands that compare methods on scenes: ``coliags compare``, ``ablate``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import coliags, print_summary

if TYPE_CHECKING:
    from coliags_plugin.comparison.named_files import Variant


@dataclass(frozen=True, kw_only=True)
class ComparisonArguments:
    """Scenes, options of the runs, and how they are carried out."""

    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE...")]
    """Benchmarks (`coliags list benchmarks`), BENCHMARK/SCENE, paths of benchmark files, or folders of scenes."""
    output: arguments.Output
    """Folder of the comparison; one that is there is extended."""
    seeds: int = 1
    """Runs of every method on every scene, with the seeds 0, 1, ..."""
    protocol: str = "paper"
    """Evaluation protocol (`coliags list protocols`)."""
    steps: arguments.OptionalInt = None
    """Training steps of all runs; default: each method's own."""
    splits: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SPLIT...")] = ()
    """Splits, each trained apart, for instance every-8th block; default: the scene's own."""
    reference: arguments.OptionalText = None
    """Reference method of the statistical tests in reports, fixed before the first run; only for a new folder."""
    primary: Annotated[tuple[str, ...], tyro.conf.arg(metavar="METRIC...")] = ()
    """Metrics decided likewise; in reports, p-values of others are exploratory and have no stars."""
    jobs: arguments.OptionalInt = None
    """Runs at a time; default: one per CPU, or per GPU."""
    threads: arguments.OptionalInt = None
    """CPU threads of each run; default: the CPUs divided by the runs at a time."""
    executor: Annotated[str, tyro.conf.arg(metavar="local|ray")] = "local"
    """Where the runs are: processes on this machine, or on a Ray cluster (`pip install "coliags_plugin[sweep]"`)."""
    ray_address: arguments.OptionalText = None
    """HOST:PORT of the Ray cluster's head; default: RAY_ADDRESS, or the cluster of this machine."""
    retries: int = 2
    """How often a run is resumed whose process was killed or crashed."""
    dry_run: bool = False
    """Only print what would be done: every cell with its state."""
    set: arguments.Assignments = ()
    """Change a value of every method config, as for train."""
    data: arguments.OptionalPath = None
    """Folder of the benchmark's scenes; default scenes/BENCHMARK. Phantoms that are missing are made there."""
    device: arguments.Device = "auto"
    json: arguments.AsJson = False

    def carry_out(self, methods: Sequence[str | Variant]) -> None:
        """Compare and print a summary; exit with status 1 if a cell failed."""
        from coliags_plugin.comparison.compare import carry_out, dry_run, make_request
        from coliags_plugin.comparison.folder import ComparisonFolder
        from coliags_plugin.execution.executors import ExecutionOptions

        request = arguments.call(make_request, self, methods=methods, overrides=self.set)
        folder = ComparisonFolder(self.output)
        if self.dry_run:
            planned = dry_run(request, folder)
            print_summary(str(planned), {"cells": planned.rows}, as_json=self.json)
            return
        done = carry_out(request, folder, arguments.call(ExecutionOptions, self))
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
class CompareCommand(ComparisonArguments):
    """Train and evaluate methods on scenes; what is done is kept, and what was interrupted goes on.

    The same command goes on after any interruption. Exit status 1 if a cell failed; the others are done all the same.
    """

    methods: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="METHOD...")]
    """Names of methods (`coliags list methods`) or paths of YAML files."""

    def run(self) -> None:
        """Compare and print a summary."""
        self.carry_out(self.methods)


@dataclass(frozen=True, kw_only=True)
class AblateCommand(ComparisonArguments):
    """Train and evaluate the variants that a file names on scenes; otherwise as compare."""

    file: tyro.conf.Positional[str]
    """Name of an ablation (`coliags list ablations`) or path of a YAML file."""

    def run(self) -> None:
        """Compare the variants and print a summary."""
        from coliags_plugin.comparison.named_files import load_ablation

        self.carry_out(load_ablation(self.file))
