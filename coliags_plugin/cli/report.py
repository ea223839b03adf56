"""``coliags report``: compare runs in one HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from coliags_plugin.cli.arguments import OptionalText


@dataclass(frozen=True)
class Report:
    """Compare evaluated runs of one scene in one self-contained HTML file."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, each evaluated with `coliags eval`."""
    output: Path = Path("report.html")
    """File to write."""
    protocol: str = "paper"
    """Evaluation protocol to show."""
    frames: int = 4
    """Held-out frames to show per test set."""
    title: OptionalText = None
    """Heading; default: the scene."""
    note: OptionalText = None
    """A remark shown at the top."""

    def run(self) -> None:
        """Write the report and print its path."""
        from coliags_plugin.reporting.html_report import write_report

        write_report(self.runs, self.output, self.protocol, self.frames, self.title, self.note)
        print(self.output.resolve())
