"""``coliags import``: a file of Gaussians as a run on a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import DataFormat, OptionalPath


@dataclass(frozen=True)
class Import:
    """Make a run folder of anyone's file of 3D Gaussians, which eval, render, mesh and report take like any other."""

    file: tyro.conf.Positional[Path]
    """PLY (3DGS's attributes; 2DGS's, without scale_2), SPZ or .splat, in the world frame and unit of the scene."""
    data: Path
    """The scene's folder."""
    format: DataFormat = None
    """Dataset format (`coliags list datamanagers`); default: recognised from the files."""
    output: OptionalPath = None
    """Run folder; default runs/SCENE/imported/STAMP."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""
    overwrite: bool = False
    """Replace an existing run folder."""
    anonymous: bool = False
    """Keep absolute paths out of the run's files (docs/security.md 4); eval and others then need --data."""

    def run(self) -> None:
        """Import and print the run folder."""
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
        print(run.path)
