"""``coliags poses export``: the sub-maps of a procedure for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class PosesExportCommand:
    """Export the sub-maps of a long video: COLMAP and nerfstudio layouts, trajectories, and how they are joined."""

    procedure: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder that `coliags reconstruct` made of a long video."""
    output: arguments.Output
    """Folder to create."""
    link: bool = False
    """Do not copy images and depth, but give the files in OUT a second name, on the same disk: they take no space, and
    who changes one changes both."""
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Export, and print the sub-maps."""
        from coliags_plugin.pipeline.procedure.export import MANIFEST, export_atlas

        manifest = export_atlas(self.procedure, self.output, self.overwrite, self.link)
        lines = [
            f"{one['name']}: {len(one['frames'])} frames, unit {one['unit']}"
            + ("" if one["nerfstudio"] else ", no dense depth")
            + (f", joined to {one['joined_to']}" if one["joined_to"] != one["name"] else "")
            for one in manifest["submaps"]
        ]
        lines += [f"not read: {problem}" for problem in manifest["not_read"]]
        print_summary("\n".join(lines), manifest, written=[self.output / MANIFEST], as_json=self.json)
