"""``coliags export``: the Gaussians of a run as a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class ExportCommand:
    """Write the Gaussians of a run to a file that viewers open, and a record of what it is and loses beside it."""

    path: arguments.RunFolder
    """Run folder of a splatting method."""
    output: arguments.OptionalOutput = None
    """File to write; default RUN/export/SCENE.FORMAT. The record is FILE.json."""
    light: Literal["mean", "flattened"] = "mean"
    """Light that is baked into the colours of methods whose colours depend on the lamp: that of the mean training
    camera, or the same distance and angle everywhere."""
    measure: bool = True
    """Compare the file with the run on the held-out views, for the record."""
    format: Literal["ply", "spz", "splat", "glb"] = "ply"
    """PLY as 3DGS writes it, SPZ, .splat, or glTF with KHR_gaussian_splatting. Lengths stay those of the scene (mm)."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Export, and print what was written."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        exported = run.export(
            self.output, self.format, light=self.light, measure=self.measure, overwrite=self.overwrite
        )
        print_summary(facts=exported.record, written=[exported.file, exported.record_file], as_json=self.json)
