"""``coliags export``: the Gaussians of a run as a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import OptionalPath


@dataclass(frozen=True)
class Export:
    """Write the Gaussians of a run to a file that viewers open, and a record of what it is and loses beside it."""

    path: tyro.conf.Positional[Path]
    """Run folder of a splatting method."""
    format: Literal["ply", "spz", "splat", "glb"] = "ply"
    """PLY as 3DGS writes it, SPZ, .splat, or glTF with KHR_gaussian_splatting. Lengths stay those of the scene (mm)."""
    output: OptionalPath = None
    """File to write; default RUN/export/SCENE.FORMAT. The record is FILE.json."""
    light: Literal["mean", "flattened"] = "mean"
    """Light that is baked into the colours of methods whose colours depend on the lamp: that of the mean training
    camera, or the same distance and angle everywhere."""
    measure: bool = True
    """Compare the file with the run on the held-out views, for the record."""
    data: OptionalPath = None
    """The scene's folder, where it has moved since training."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""
    overwrite: bool = False
    """Replace the file where it exists."""

    def run(self) -> None:
        """Export, print what it cost, and print the file."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        print(
            run.export(self.output, self.format, light=self.light, measure=self.measure, overwrite=self.overwrite).file
        )
