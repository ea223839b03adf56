"""``coliags depth``: one module per subcommand. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli.depth.check import DepthCheckCommand
from coliags_plugin.cli.depth.estimate import DepthEstimateCommand

Subcommand = (
    Annotated[DepthEstimateCommand, tyro.conf.subcommand("estimate")]
    | Annotated[DepthCheckCommand, tyro.conf.subcommand("check")]
)


@dataclass(frozen=True)
class DepthCommand:
    """Estimate the depth of posed images, or compare estimated with true depth."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
