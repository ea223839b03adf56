"""``coliags poses``: one module per subcommand. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli.poses.align import PosesAlignCommand
from coliags_plugin.cli.poses.convert import PosesConvertCommand
from coliags_plugin.cli.poses.sfm import PosesSfmCommand
from coliags_plugin.cli.poses.track import PosesTrackCommand
from coliags_plugin.cli.poses.triangulate import PosesTriangulateCommand

Subcommand = (
    Annotated[PosesConvertCommand, tyro.conf.subcommand("convert")]
    | Annotated[PosesAlignCommand, tyro.conf.subcommand("align")]
    | Annotated[PosesTriangulateCommand, tyro.conf.subcommand("triangulate")]
    | Annotated[PosesSfmCommand, tyro.conf.subcommand("sfm")]
    | Annotated[PosesTrackCommand, tyro.conf.subcommand("track")]
)


@dataclass(frozen=True)
class PosesCommand:
    """Convert and compare camera poses, triangulate points, or estimate poses from images or depth."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
