"""``coliags depth``: one module per subcommand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from coliags_plugin.cli.depth.check import CheckDepth


@dataclass(frozen=True)
class Depth:
    """Compare estimated with true depth: error, bias, coverage, and whether the stated confidence is right."""

    action: tyro.conf.Positional[Literal["check"]]
    """What to do."""
    check: tyro.conf.OmitArgPrefixes[CheckDepth]
    """Options of the comparison."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.check.run()
