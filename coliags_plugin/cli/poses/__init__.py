"""``coliags poses``: its subcommands. To add one, add its class to ``Subcommand``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.poses.structure import PosesSfmCommand
from coliags_plugin.cli.poses.trajectories import PosesAlignCommand, PosesConvertCommand

Subcommand = (
    Annotated[PosesConvertCommand, tyro.conf.subcommand("convert")]
    | Annotated[PosesAlignCommand, tyro.conf.subcommand("align")]
    | Annotated[PosesSfmCommand, tyro.conf.subcommand("sfm")]
)


@dataclass(frozen=True)
class PosesCommand(arguments.CommandGroup):
    """Convert and compare camera poses, or estimate them from images."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""
