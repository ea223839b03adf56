"""``coliags train``: train a method on a scene."""

from __future__ import annotations

from dataclasses import dataclass

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
    set: arguments.Assignments = ()
    """Change a value of the method config, for instance field.voxel_size=1.0."""
    format: arguments.DataFormat = None
    device: arguments.Device = "auto"
    overwrite: arguments.Overwrite = False
    anonymous: arguments.AnonymousRun = False
    json: arguments.AsJson = False

    def run(self) -> None:
        """Train, and print the run folder."""
        from coliags_plugin.api.training import train
        from coliags_plugin.config.assignments import parse_assignments

        run = train(
            self.method,
            self.data,
            self.output,
            steps=self.steps,
            seed=self.seed,
            settings=parse_assignments(self.set),
            renderer=self.renderer,
            data_format=self.format,
            device=self.device,
            resume=self.resume,
            overwrite=self.overwrite,
            anonymous=self.anonymous,
        )
        moved = ("--data", self.data) if self.anonymous else ()
        facts = {"method": run.method, "scene": run.scene_name, "seed": run.seed, "step": run.step}
        print_summary(facts=facts, written=[run.path], then=[coliags("eval", run.path, *moved)], as_json=self.json)
