"""``coliags mesh``: triangle mesh of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, view_command


@dataclass(frozen=True)
class MeshCommand:
    """Make a triangle mesh of a run, and compare it with the true surface where there is one."""

    path: arguments.RunFolder
    output: arguments.OptionalOutput = None
    """Folder to create; default RUN/mesh."""
    voxel: arguments.OptionalFloat = None
    """Edge of a voxel in scene units (mm); default: two training pixels on the surface."""
    color: Literal["plain", "flattened"] = "plain"
    """Colours: as the views show them, each under its lamp; or under one distance and angle to the lamp everywhere, the
    medians of what the training views see, for methods of Gaussians."""
    truth: arguments.OptionalPath = None
    """True surface to compare with: a mesh in the world of the scene, mm, or the folder of a scene with one; default:
    that of the scene, where there is one."""
    set: arguments.Assignments = ()
    """Another option of meshing (docs/meshes.md 3), for instance depth=median."""
    format: tuple[Literal["ply", "obj", "glb"], ...] = ("ply", "obj", "glb")
    """Formats of the mesh."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Make the mesh, and print the comparison."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.config.assignments import parse_assignments
        from coliags_plugin.reporting.terminal import terminal_text
        from coliags_plugin.surface.meshing.writing import comparison_blocks

        settings = parse_assignments(self.set, "--set", "KEY=VALUE, for instance depth=median")
        settings.setdefault("color", self.color)
        if self.voxel is not None:
            settings["voxel_size"] = self.voxel
        run = load_run(self.path, data=self.data, device=self.device)
        meshed = run.mesh(
            self.output, settings=settings, formats=self.format, truth=self.truth, overwrite=self.overwrite
        )
        compared = meshed.comparison
        print_summary(
            "" if compared is None else terminal_text(comparison_blocks(compared)),
            {"comparison": None if compared is None else compared.as_json()},
            written=[meshed.folder],
            then=[view_command(self.path, self.data)],
            as_json=self.json,
        )
