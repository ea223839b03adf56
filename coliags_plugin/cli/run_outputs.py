"""Commands that show what a run has learned: ``coliags render``, ``coverage``, ``mesh``, ``export``, ``view``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, view_command


@dataclass(frozen=True)
class RenderCommand:
    """Render rgb, depth and error images of a run, and a video along its trajectory."""

    path: arguments.RunFolder
    output: arguments.OptionalOutput = None
    """Folder to create; default RUN/renders, with --light or --flatten RUN/relit, with --path RUN/path."""
    along: Annotated[arguments.OptionalPath, tyro.conf.arg(name="path")] = None
    """Render only a video along this camera path, a file saved in `coliags view`."""
    frames: str = "test"
    """Which frames: train, all, or the name of a test set."""
    video: arguments.DoneByDefault = True
    """Do not write trajectory.mp4, rgb beside depth."""
    fps: float = 15.0
    """Frames per second of the video."""
    depth_kind: Literal["accumulated", "expected", "median"] = "expected"
    """Which depth: sum w z, the paper's; the same divided by alpha; or that of the Gaussian at which half of the light
    is absorbed. Pictures are hatched where alpha is below 0.5."""
    depth_tiff: bool = False
    """Also write depth as float32 TIFF, scene units: depth_tiff/."""
    light: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE"), tyro.conf.UseAppendAction] = ()
    """Render under another lamp, for methods that model it: offset=[X,Y,Z] from the camera in its axes (mm),
    turn=[A,B] about its x and y axes (degrees), power=P (exponent of the cosine to the lamp's axis), intensity=F
    (factor)."""
    flatten: bool = False
    """Render every wall point as at one distance and angle from the lamp, without gain: default folder RUN/relit."""
    channel: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction] = ()
    """Also write a feature channel of the method's Gaussians, for instance albedo."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Render, and print the output folder."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.config.assignments import parse_assignments
        from coliags_plugin.core.errors import InputError

        lamp = parse_assignments(self.light, "--light", "KEY=VALUE, for instance power=10")
        if lamp and self.flatten:
            raise InputError("--light and --flatten together", "one of them")
        run = load_run(self.path, data=self.data, device=self.device)
        if lamp:
            run = run.relight(**lamp)
        if self.flatten:
            run = run.flatten()
        folder = arguments.call(run.write_renders, self, channels=self.channel)
        print_summary(written=[folder], then=[view_command(self.path, self.data)], as_json=self.json)


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
    """The wall, PLY, OBJ or GLB, in the world and unit of the poses; default: RUN/mesh/mesh.ply, or else the fused
    depth of the run."""
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

        settings = parse_assignments(self.set, "--set", "KEY=VALUE, for instance region_diameter=10")
        is_run = (self.path / "config.yaml").is_file()
        if is_run:
            run = load_run(self.path, data=self.data, device=self.device)
            measured = arguments.call(run.coverage, self, settings=settings)
        elif self.mesh is None or self.output is None:
            raise InputError(
                f"{self.path} is not a run folder",
                "a run folder, or a scene's folder with --mesh FILE and --output FOLDER",
            )
        else:
            measured = arguments.call(measure_scene_coverage, self, data=self.path, settings=settings)
        print_summary(
            "\n".join(measured.summary),
            measured.values,
            written=[measured.folder],
            then=[view_command(self.path, self.data)] if is_run else [],
            as_json=self.json,
        )


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
    texture: bool = False
    """OBJ, with MTL and PNG, and GLB with a texture in place of colours at vertices: four texels along the edge of a
    voxel."""
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
        from coliags_plugin.reporting.text_formats import terminal_text
        from coliags_plugin.surface.meshing.writing import comparison_blocks

        settings = parse_assignments(self.set, "--set", "KEY=VALUE, for instance depth=median")
        settings.setdefault("color", self.color)
        if self.texture:
            settings.setdefault("texture", 4.0)
        if self.voxel is not None:
            settings["voxel_size"] = self.voxel
        run = load_run(self.path, data=self.data, device=self.device)
        meshed = arguments.call(run.mesh, self, settings=settings, formats=self.format)
        compared = meshed.comparison
        print_summary(
            "" if compared is None else terminal_text(comparison_blocks(compared)),
            {"comparison": None if compared is None else compared.as_json()},
            written=[meshed.folder],
            then=[view_command(self.path, self.data)],
            as_json=self.json,
        )


@dataclass(frozen=True)
class ExportCommand:
    """Write the Gaussians of a run to a file that viewers open, and a record of what it is and loses beside it."""

    path: arguments.RunFolder
    """Run folder of a splatting method."""
    output: arguments.OptionalOutput = None
    """File to write; default RUN/export/SCENE.FORMAT. The record is FILE.json. Of several formats, each has its own
    suffix."""
    light: Literal["recorded", "mean", "flattened"] = "mean"
    """Light baked into colours that depend on the lamp. recorded: the lamp of each training camera, averaged; mean: a
    lamp at the mean training camera; flattened: the same distance and angle everywhere."""
    seconds: float = 180.0
    """Time limit, seconds, of the fit of baked Gaussians to the run's renderings, done where baking loses much."""
    measure: arguments.DoneByDefault = True
    """Do not compare each file with the run on the held-out views, for the record and the terminal."""
    format: tuple[Literal["ply", "spz", "glb"], ...] = ("ply",)
    """Formats, all of one baking: PLY as 3DGS writes it, SPZ, glTF with KHR_gaussian_splatting. Lengths stay
    those of the scene (mm)."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Export, and print what was written."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        exported = run.export(
            self.output,
            *self.format,
            light=self.light,
            seconds=self.seconds,
            measure=self.measure,
            overwrite=self.overwrite,
        )
        records = [one.record for one in exported]
        print_summary(
            "\n".join(one.text for one in exported),
            facts=records[0] if len(records) == 1 else {"files": records},
            written=[path for one in exported for path in (one.file, one.record_file)],
            as_json=self.json,
        )


@dataclass(frozen=True)
class ViewCommand:
    """Show a run in a browser, which needs the extra `viewer`, or write it as a page: Gaussians, meshes, frames."""

    path: arguments.RunFolder
    output: arguments.OptionalOutput = None
    """Write the scene to this file instead, as a self-contained HTML page, which opens offline."""
    size: str = "5MB"
    """Of the page, at most, for instance 20MB."""
    light: Literal["recorded", "mean", "flattened"] = "recorded"
    """Of the page, as in `coliags export`."""
    seconds: float = 180.0
    """Time limit, seconds, of the fit of the page's Gaussians to the run's renderings."""
    host: str = "127.0.0.1"
    """Name or address to listen on; 0.0.0.0: all of this machine, for anyone who can reach it. From another machine,
    better: ssh -L 8080:localhost:8080 THIS_MACHINE, and open http://localhost:8080 there."""
    port: int = 8080
    """Port to listen on; 0: any free one."""
    open: arguments.DoneByDefault = True
    """Do not open a browser (by default one is opened where there is a display)."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    json: arguments.AsJson = False

    def run(self) -> None:
        """Serve the run until Ctrl-C, or write the page."""
        from coliags_plugin.api.runs import load_run

        size = arguments.bytes_of(self.size, "--size")
        run = load_run(self.path, data=self.data, device=self.device)
        if self.output is not None:
            page = run.save_view(self.output, size=size, light=self.light, seconds=self.seconds)
            print_summary(page.text, page.facts, written=[self.output], as_json=self.json)
            return
        try:
            with run.view(host=self.host, port=self.port) as viewer:
                print(f"{viewer.url} (Ctrl-C ends it)", flush=True)
                if self.open:
                    viewer.open()
                viewer.wait()
        except KeyboardInterrupt:
            print("ended")
