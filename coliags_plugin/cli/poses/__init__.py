"""``coliags poses``: one module per subcommand. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli.poses.align import Align
from coliags_plugin.cli.poses.convert import Convert
from coliags_plugin.cli.poses.sfm import Sfm
from coliags_plugin.cli.poses.track import Track
from coliags_plugin.cli.poses.triangulate import Triangulate

Subcommand = (
    Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Align, tyro.conf.subcommand("align")]
    | Annotated[Triangulate, tyro.conf.subcommand("triangulate")]
    | Annotated[Sfm, tyro.conf.subcommand("sfm")]
    | Annotated[Track, tyro.conf.subcommand("track")]
)


@dataclass(frozen=True)
class Poses:
    """Convert and compare camera poses, triangulate points, or estimate poses from images or depth."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
