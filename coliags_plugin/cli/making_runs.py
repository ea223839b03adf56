"""Commands that make and evaluate a run: ``coliags train``, ``eval``, ``import``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import coliags, print_summary


@dataclass(frozen=True)
class TrainCommand:
    """Train a method on a scene and write a run folder."""

    method: tyro.conf.Positional[str]
    """Name of a method (`coliags list methods`) or path of a YAML file."""
    data: arguments.SceneFolder
    output: arguments.OptionalOutput = None
    """Run folder; default runs/SCENE/METHOD/STAMP."""
    steps: arguments.OptionalInt = None
    """Training steps; schedules are scaled to them. A resumed run keeps its own unless given."""
    seed: arguments.OptionalInt = None
    """Seed of all random generators; default 0, for a resumed run its own."""
    renderer: arguments.OptionalText = None
    """Renderer by name (`coliags list renderers`); default: the method's."""
    resume: bool = False
    """Continue from the run's latest checkpoint (without --output: the newest run of this method on this scene)."""
    view: bool = False
    """Show the run in a browser while it is trained (extra `viewer`)."""
    port: int = 8080
    """Port of --view on this machine; 0: any free one."""
    logger: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction] = ()
    """Also log to tensorboard or wandb, into the run folder (extra `loggers`), repeatable."""
    set: arguments.Assignments = ()
    """Change a value of the method config, for instance field.voxel_size=1.0."""
    format: arguments.DataFormat = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Train, and print the run folder."""
        from coliags_plugin.api.training import train
        from coliags_plugin.config.assignments import parse_assignments

        run = arguments.call(
            train,
            self,
            settings=parse_assignments(self.set),
            data_format=self.format,
            loggers=self.logger,
            view_port=self.port if self.view else None,
        )
        facts = {"method": run.method, "scene": run.scene_name, "seed": run.seed, "step": run.step}
        print_summary(facts=facts, written=[run.path], then=[coliags("eval", run.path)], as_json=self.json)


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate a run on its held-out frames under a protocol."""

    path: arguments.RunFolder
    protocol: arguments.OptionalText = None
    """Protocol by name (`coliags list protocols`); default: the method config's."""
    truth: arguments.OptionalPath = None
    """A scene of the same frames and poses with true depth, to evaluate against instead of the run's own, for runs
    trained on estimated depth; results go into eval/PROTOCOL-truth."""
    refine_poses: bool = False
    """Also measure views from poses refined on the held-out images themselves, as psnr_pose_refined
    (docs/protocols.md); not comparable with psnr."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    json: arguments.AsJson = False

    def run(self) -> None:
        """Evaluate and print a table."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.results.summaries import means_summary

        run = load_run(self.path, data=self.data, device=self.device)
        result = run.evaluate(self.protocol, truth=self.truth, refine_poses=self.refine_poses)
        name = result.evaluation_name
        shown = () if name == "paper" else ("--protocol", name)
        print_summary(
            str(result),
            means_summary(result),
            written=[run.folder.evaluations / name / "metrics.json"],
            then=[coliags("report", self.path, *shown)],
            as_json=self.json,
        )


@dataclass(frozen=True)
class ImportCommand:
    """Make a run folder of anyone's file of 3D Gaussians, which eval, render, mesh and report take like any other."""

    file: tyro.conf.Positional[Path]
    """PLY (3DGS's attributes; 2DGS's, without scale_2) or SPZ, in the world frame and unit of the scene."""
    data: arguments.SceneFolder
    output: arguments.OptionalOutput = None
    """Run folder; default runs/SCENE/imported/STAMP."""
    format: arguments.DataFormat = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Import, and print the run folder."""
        from coliags_plugin.api.training import import_splats

        run = arguments.call(import_splats, self, data_format=self.format)
        print_summary(written=[run.path], then=[coliags("eval", run.path)], as_json=self.json)
