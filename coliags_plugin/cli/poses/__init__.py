"""``coliags poses``: one small file per subcommand. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli.poses.align import Align
from coliags_plugin.cli.poses.convert import Convert

Subcommand = Annotated[Convert, tyro.conf.subcommand("convert")] | Annotated[Align, tyro.conf.subcommand("align")]


@dataclass(frozen=True)
class Poses:
    """Bring camera poses from one format to another, and compare trajectories."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """What to do."""

    def run(self) -> None:
        """Do it."""
        self.subcommand.run()
