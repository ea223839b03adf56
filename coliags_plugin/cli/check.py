"""``coliags check``: check that a method keeps the contract of all methods."""

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class CheckCommand:
    """Check that a method trains, resumes, renders and fails as it should, on the CPU; exit status 1 if not."""

    method: tyro.conf.Positional[str]
    """Name of a method (`coliags list methods`) or path of a YAML file."""
    steps: int = 20
    """Length of the runs; schedules are scaled to it."""
    keep: bool = False
    """Keep the folder with the phantom and the runs, and print its path."""
    traceback: bool = False
    """Print the whole traceback of every exception."""
    set: arguments.Assignments = ()
    """Change a value of the method config, as for train."""
    format: arguments.DataFormat = None
    data: arguments.OptionalPath = None
    """A scene's folder; default: a small phantom."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Print one line per check, then a summary."""
        logger = logging.getLogger("coliags_plugin")
        level, folder = logger.level, Path(tempfile.mkdtemp(prefix="coliags-check-"))
        logger.setLevel(logging.WARNING)  # the plans of a dozen runs
        try:
            failed = self._print_results(folder)
        finally:
            logger.setLevel(level)
            if not self.keep:
                shutil.rmtree(folder, ignore_errors=True)
        if failed:
            sys.exit(1)

    def _print_results(self, folder: Path) -> bool:
        """Whether a check failed."""
        from coliags_plugin.checks.method.check import CHECKS, check_method
        from coliags_plugin.checks.results import line, summary, tracebacks

        encoding, width = sys.stdout.encoding or "ascii", max(len(check.name) for check in CHECKS)
        results = []
        for result in check_method(self.method, folder, self.set, self.data, self.format, self.steps):
            results.append(result)
            if not self.json:
                print(line(result, width, encoding), flush=True)
        text = summary(results)
        if self.traceback:
            text += "\n" + "".join(tracebacks(results, encoding))
        facts = {"checks": [asdict(result) for result in results]}
        print_summary(text, facts, written=[folder] if self.keep else [], as_json=self.json)
        return any(result.status == "failed" for result in results)
