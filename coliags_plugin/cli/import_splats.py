"""``coliags import``: a file of Gaussians as a run on a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import coliags, print_summary


@dataclass(frozen=True)
class ImportCommand:
    """Make a run folder of anyone's file of 3D Gaussians, which eval, render, mesh and report take like any other."""

    file: tyro.conf.Positional[Path]
    """PLY (3DGS's attributes; 2DGS's, without scale_2), SPZ or .splat, in the world frame and unit of the scene."""
    data: arguments.SceneFolder
    output: arguments.OptionalOutput = None
    """Run folder; default runs/SCENE/imported/STAMP."""
    format: arguments.DataFormat = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    anonymous: arguments.AnonymousRun = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Import, and print the run folder."""
        from coliags_plugin.api.training import import_splats

        run = import_splats(
            self.file,
            self.data,
            self.output,
            data_format=self.format,
            device=self.device,
            overwrite=self.overwrite,
            anonymous=self.anonymous,
        )
        moved = ("--data", self.data) if self.anonymous else ()
        evaluate = coliags("eval", run.path, *moved)
        print_summary(written=[run.path], then=[evaluate], as_json=self.json)
