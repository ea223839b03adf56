"""``coliags coverage``: what a recording shows of the wall, and what it misses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import Assignments, OptionalPath


@dataclass(frozen=True)
class Coverage:
    """Measure what a recording shows of the lumen's wall and what it misses: map, list of missed regions, mesh, page.

    Research use only.
    """

    path: tyro.conf.Positional[Path]
    """Run folder; or a scene's folder, with --mesh and --out."""
    mesh: OptionalPath = None
    """The wall, PLY, OBJ or GLB, in mm in the world of the poses; default: RUN/mesh/mesh.ply, or else the fused depth
    of the run."""
    truth: OptionalPath = None
    """True surface to measure against: a mesh in the world of the scene, mm, or the folder of a scene with one;
    default: that of the scene, where there is one."""
    out: OptionalPath = None
    """Folder to create; default RUN/coverage."""
    data: OptionalPath = None
    """The scene's folder, where it has moved since training."""
    set: Assignments = ()
    """An option, for instance region_diameter=10 (docs/coverage.md)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to render a run's depth on."""
    overwrite: bool = False
    """Replace the output folder where it exists."""

    def run(self) -> None:
        """Measure, write the folder and print a summary."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.api.scenes import measure_scene_coverage
        from coliags_plugin.config.assignments import parse_assignments
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.surface.coverage.page import summary

        settings = parse_assignments(self.set, "--set", "KEY=VALUE, for instance region_diameter=10")
        if (self.path / "config.yaml").is_file():
            run = load_run(self.path, data=self.data, device=self.device)
            made = run.coverage(self.out, settings=settings, mesh=self.mesh, truth=self.truth, overwrite=self.overwrite)
        elif self.mesh is None or self.out is None:
            raise InputError(
                f"{self.path} is not a run folder",
                "a run folder, or a scene's folder with --mesh FILE and --out FOLDER",
            )
        else:
            made = measure_scene_coverage(
                self.path, self.mesh, self.out, settings=settings, truth=self.truth, overwrite=self.overwrite
            )
        print("\n".join([*summary(made.coverage, made.evaluation), str(made.folder)]))
