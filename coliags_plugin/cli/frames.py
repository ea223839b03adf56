"""``coliags frames``: the frames of a reconstruction on disk, or in the video alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import coliags, print_summary


@dataclass(frozen=True)
class _FramesCommand:
    reconstruction: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `coliags reconstruct` made."""
    video: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIDEO")]
    """The video, or folder of images, that it was made of."""
    json: arguments.AsJson = False


@dataclass(frozen=True)
class FramesRemoveCommand(_FramesCommand):
    """Remove the frames that a reconstruction has decoded, after comparing each with the video; results stay."""

    def run(self) -> None:
        """Remove, and print how much space that frees."""
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.pipeline.frame_storage import remove_frames

        with progress_callback() as progress:
            freed = remove_frames(self.reconstruction, self.video, progress)
        restore = coliags("frames", "restore", self.reconstruction, self.video)
        print_summary(f"{freed / 1e6:,.1f} MB freed", {"freed_bytes": freed}, then=[restore], as_json=self.json)


@dataclass(frozen=True)
class FramesRestoreCommand(_FramesCommand):
    """Decode removed frames again, equal in every pixel."""

    def run(self) -> None:
        """Restore, and print how many."""
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.pipeline.frame_storage import restore_frames

        with progress_callback() as progress:
            count = restore_frames(self.reconstruction, self.video, progress)
        print_summary(f"{count} frames restored", {"frames": count}, as_json=self.json)


Subcommand = (
    Annotated[FramesRemoveCommand, tyro.conf.subcommand("remove")]
    | Annotated[FramesRestoreCommand, tyro.conf.subcommand("restore")]
)


@dataclass(frozen=True)
class FramesCommand(arguments.CommandGroup):
    """Keep the frames of a reconstruction in its video alone, or decode them again."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""
