"""``coliags mesh``: triangle mesh of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli.arguments import Assignments, OptionalPath


@dataclass(frozen=True)
class Mesh:
    """Make a triangle mesh of a run, and compare it with the true surface where there is one."""

    path: tyro.conf.Positional[Path]
    """Run folder."""
    out: OptionalPath = None
    """Folder to create; default RUN/mesh."""
    voxel: Annotated[float | None, tyro.conf.arg(metavar="MM")] = None
    """Edge of a voxel in scene units (mm); default: two training pixels on the surface."""
    format: tuple[Literal["ply", "obj", "glb"], ...] = ("ply", "obj", "glb")
    """Formats of the mesh."""
    color: Literal["plain", "flattened"] = "plain"
    """Colours: as the views show them, each under its lamp; or under one distance and angle to the lamp everywhere, the
    medians of what the training views see, for methods of Gaussians."""
    set: Assignments = ()
    """Another option of meshing (docs/meshes.md 3), for instance depth=median."""
    truth: OptionalPath = None
    """True surface to compare with: a mesh in the world of the scene, mm, or the folder of a scene with one; default:
    that of the scene, where there is one."""
    data: OptionalPath = None
    """The scene's folder, where it has moved since training."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to render on."""
    overwrite: bool = False
    """Replace the output folder where it exists."""

    def run(self) -> None:
        """Make the mesh, print the comparison, and print the folder."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.config.assignments import parse_assignments
        from coliags_plugin.reporting.terminal import terminal_text
        from coliags_plugin.surface.meshing.writing import comparison_blocks

        settings = parse_assignments(self.set, "--set", "KEY=VALUE, for instance depth=median")
        settings.setdefault("color", self.color)
        if self.voxel is not None:
            settings["voxel_size"] = self.voxel
        run = load_run(self.path, data=self.data, device=self.device)
        meshed = run.mesh(self.out, settings=settings, formats=self.format, truth=self.truth, overwrite=self.overwrite)
        if meshed.comparison is not None:
            print(terminal_text(comparison_blocks(meshed.comparison)))
        print(meshed.folder)
