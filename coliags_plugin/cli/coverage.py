"""``coliags coverage``: what a recording shows of the wall, and what it misses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, view_command


@dataclass(frozen=True)
class CoverageCommand:
    """Measure what a recording shows of the lumen's wall and what it misses: map, list of missed regions, mesh, page.

    Research use only.
    """

    path: tyro.conf.Positional[Path]
    """Run folder; or a scene's folder, with --mesh and --output."""
    output: arguments.OptionalOutput = None
    """Folder to create; default RUN/coverage."""
    mesh: arguments.OptionalPath = None
    """The wall, PLY, OBJ or GLB, in mm in the world of the poses; default: RUN/mesh/mesh.ply, or else the fused depth
    of the run."""
    truth: arguments.OptionalPath = None
    """True surface to measure against: a mesh in the world of the scene, mm, or the folder of a scene with one;
    default: that of the scene, where there is one."""
    set: arguments.Assignments = ()
    """An option, for instance region_diameter=10 (docs/coverage.md)."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Measure, write the folder and print a summary."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.api.scenes import measure_scene_coverage
        from coliags_plugin.config.assignments import parse_assignments
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.surface.coverage.page import summary
        from coliags_plugin.surface.coverage.writing import coverage_values

        settings = parse_assignments(self.set, "--set", "KEY=VALUE, for instance region_diameter=10")
        is_run = (self.path / "config.yaml").is_file()
        if is_run:
            run = load_run(self.path, data=self.data, device=self.device)
            measured = run.coverage(
                self.output, settings=settings, mesh=self.mesh, truth=self.truth, overwrite=self.overwrite
            )
        elif self.mesh is None or self.output is None:
            raise InputError(
                f"{self.path} is not a run folder",
                "a run folder, or a scene's folder with --mesh FILE and --output FOLDER",
            )
        else:
            measured = measure_scene_coverage(
                self.path, self.mesh, self.output, settings=settings, truth=self.truth, overwrite=self.overwrite
            )
        print_summary(
            "\n".join(summary(measured.coverage, measured.evaluation)),
            coverage_values(measured.coverage, measured.evaluation),
            written=[measured.folder],
            then=[view_command(self.path, self.data)] if is_run else [],
            as_json=self.json,
        )
