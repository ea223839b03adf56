"""``coliags train``: train a method on a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import Assignments, DataFormat, OptionalInt, OptionalPath, OptionalText


@dataclass(frozen=True)
class Train:
    """Train a method on a scene and write a run folder."""

    method: tyro.conf.Positional[str]
    """Name of a method (`coliags list methods`) or path of a YAML file."""
    data: Path
    """The scene's folder."""
    format: DataFormat = None
    """Dataset format (`coliags list datamanagers`); default: recognised from the files."""
    output: OptionalPath = None
    """Run folder; default runs/SCENE/METHOD/STAMP."""
    steps: OptionalInt = None
    """Training steps; schedules are scaled to them. A resumed run keeps its own unless given."""
    seed: OptionalInt = None
    """Seed of all random generators; default 0, for a resumed run its own."""
    renderer: OptionalText = None
    """Renderer by name (`coliags list renderers`); default: the method's."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""
    set: Assignments = ()
    """Change a value of the method config, for instance field.voxel_size=1.0."""
    resume: bool = False
    """Continue from the run's latest checkpoint (without --output: the newest run of this method on this scene)."""
    overwrite: bool = False
    """Replace an existing run folder."""
    anonymous: bool = False
    """Keep absolute paths out of the run's files (docs/security.md 4); eval and others then need --data."""

    def run(self) -> None:
        """Train and print the run folder."""
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
        print(run.path)
