"""Commands on runs: ``train``, ``import``, ``eval``, ``render``, ``coverage``, ``mesh``, ``export``, ``view``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from coliags_plugin.cli.texts import coliags, print_summary, view_command
from coliags_plugin.config import options
from coliags_plugin.core.errors import InputError


@dataclass(frozen=True)
class TrainCommand(options.TrainOptions):
    """Train a method on a scene and write a run folder."""

    view: bool = False
    """Show the run in a browser while it is trained (extra `viewer`)."""
    port: int = 8080
    """Port of --view on this machine; 0: any free one."""
    json: options.AsJson = False

    def run(self) -> None:
        """Train, and print the run folder."""
        from coliags_plugin.api.runs import train

        run = train(self, view_port=self.port if self.view else None)
        facts = {"method": run.method, "scene": run.scene_name, "seed": run.seed, "step": run.step}
        print_summary(facts=facts, written=[run.path], then=[coliags("eval", run.path)], as_json=self.json)


@dataclass(frozen=True)
class ImportCommand(options.ImportOptions):
    """Make a run folder of anyone's file of 3D Gaussians, which eval, render, mesh and report take like any other."""

    json: options.AsJson = False

    def run(self) -> None:
        """Import, and print the run folder."""
        from coliags_plugin.api.runs import import_splats

        run = import_splats(self)
        print_summary(written=[run.path], then=[coliags("eval", run.path)], as_json=self.json)


if TYPE_CHECKING:
    from coliags_plugin.api.runs import Run


@dataclass(frozen=True, kw_only=True)
class RunCommand:
    """A command on a run."""

    path: options.RunFolder
    data: options.MovedData = None
    device: options.Device = "auto"
    json: options.AsJson = False

    def opened(self) -> Run:
        """The run."""
        from coliags_plugin.api.runs import load_run

        return load_run(self.path, data=self.data, device=self.device)


@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(RunCommand, options.EvaluateOptions):
    """Evaluate a run on its held-out frames under a protocol."""

    def run(self) -> None:
        """Evaluate and print a table."""
        run = self.opened()
        result = run.evaluate(self)
        name = result.evaluation_name
        shown = () if name == "paper" else ("--protocol", name)
        print_summary(
            str(result),
            result.summary(),
            written=[run.folder.evaluations / name / "metrics.json"],
            then=[coliags("report", self.path, *shown)],
            as_json=self.json,
        )


@dataclass(frozen=True, kw_only=True)
class RenderCommand(RunCommand, options.RenderOptions):
    """Render rgb, depth and error images of a run, and a video along its trajectory."""

    light: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE"), tyro.conf.UseAppendAction] = ()
    """Render under another lamp, for methods that model it: offset=[X,Y,Z] from the camera in its axes (mm),
    turn=[A,B] about its x and y axes (degrees), power=P (exponent of the cosine to the lamp's axis), intensity=F
    (factor)."""
    flatten: bool = False
    """Render every wall point as at one distance and angle from the lamp, without gain: default folder RUN/relit."""

    def run(self) -> None:
        """Render, and print the output folder."""
        from coliags_plugin.config.yaml_tree import parse_assignments

        lamp = parse_assignments(self.light)
        if lamp and self.flatten:
            raise InputError("--light and --flatten together", "one of them")
        run = self.opened()
        if lamp:
            run = run.relight(**lamp)
        if self.flatten:
            run = run.flatten()
        then = [view_command(self.path, self.data)]
        print_summary(written=[run.write_renders(self)], then=then, as_json=self.json)


@dataclass(frozen=True, kw_only=True)
class CoverageCommand(RunCommand, options.CoverageOptions):
    """Measure what a recording shows of the lumen's wall and what it misses: map, list of missed regions, mesh, page.

    Research use only.
    """

    path: tyro.conf.Positional[Path]
    """Run folder; or a scene's folder, with --mesh and --output."""

    def run(self) -> None:
        """Measure, write the folder and print a summary."""
        from coliags_plugin.api.scenes import measure_scene_coverage

        is_run = (self.path / "config.yaml").is_file()
        measured = self.opened().coverage(self) if is_run else measure_scene_coverage(self.path, self)
        print_summary(
            measured.summary,
            measured.values,
            written=[measured.folder],
            then=[view_command(self.path, self.data)] if is_run else [],
            as_json=self.json,
        )


@dataclass(frozen=True, kw_only=True)
class MeshCommand(RunCommand, options.MeshOptions):
    """Make a triangle mesh of a run, and compare it with the true surface where there is one."""

    def run(self) -> None:
        """Make the mesh, and print the comparison."""
        from coliags_plugin.reporting.text_formats import terminal_text

        meshed = self.opened().mesh(self)
        compared = meshed.comparison
        print_summary(
            terminal_text(meshed.comparison_blocks()),
            {"comparison": None if compared is None else compared.as_json()},
            written=[meshed.folder],
            then=[view_command(self.path, self.data)],
            as_json=self.json,
        )


@dataclass(frozen=True, kw_only=True)
class ExportCommand(RunCommand, options.ExportOptions):
    """Write the Gaussians of a run to a file that viewers open, and a record of what it is and loses beside it."""

    def run(self) -> None:
        """Export, and print what was written."""
        exported = self.opened().export(self)
        records = [exported_file.record for exported_file in exported]
        print_summary(
            "\n".join(exported_file.text for exported_file in exported),
            facts=records[0] if len(records) == 1 else {"files": records},
            written=[path for exported_file in exported for path in (exported_file.file, exported_file.record_file)],
            as_json=self.json,
        )


@dataclass(frozen=True, kw_only=True)
class ViewCommand(RunCommand, options.PageOptions):
    """Show a run in a browser, which needs the extra `viewer`, or write it as a page: Gaussians, meshes, frames."""

    host: str = "127.0.0.1"
    """Name or address to listen on; 0.0.0.0: all of this machine, for anyone who can reach it. From another machine,
    better: ssh -L 8080:localhost:8080 THIS_MACHINE, and open http://localhost:8080 there."""
    port: int = 8080
    """Port to listen on; 0: any free one."""
    open: options.DoneByDefault = True
    """Do not open a browser (by default one is opened where there is a display)."""

    def run(self) -> None:
        """Serve the run until Ctrl-C, or write the page."""
        run = self.opened()
        if self.output is not None:
            page = run.save_view(self)
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
