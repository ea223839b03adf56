"""``coliags depth``: one module per subcommand. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli.depth.check import CheckDepth
from coliags_plugin.cli.depth.estimate import EstimateDepth

Subcommand = (
    Annotated[EstimateDepth, tyro.conf.subcommand("estimate")] | Annotated[CheckDepth, tyro.conf.subcommand("check")]
)


@dataclass(frozen=True)
class Depth:
    """Estimate the depth of posed images, or compare estimated with true depth."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
