"""``coliags poses``: its subcommands. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.poses.structure import PosesSfmCommand
from coliags_plugin.cli.poses.trajectories import PosesAlignCommand, PosesConvertCommand, PosesExportCommand

Subcommand = (
    Annotated[PosesConvertCommand, tyro.conf.subcommand("convert")]
    | Annotated[PosesAlignCommand, tyro.conf.subcommand("align")]
    | Annotated[PosesSfmCommand, tyro.conf.subcommand("sfm")]
    | Annotated[PosesExportCommand, tyro.conf.subcommand("export")]
)


@dataclass(frozen=True)
class PosesCommand(arguments.CommandGroup):
    """Convert, compare and export camera poses, or estimate them from images."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""
