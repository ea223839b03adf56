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

    def run(self) -> None:
        """Train and print the run folder."""
        import logging

        from coliags_plugin.config.method_config import method_name
        from coliags_plugin.core.errors import InputError
        from coliags_plugin.engine.backends import choose_device
        from coliags_plugin.engine.data_formats import load_method_for, load_scene
        from coliags_plugin.engine.resuming import resumed_method, resumed_seed
        from coliags_plugin.engine.run_folder import RunFolder
        from coliags_plugin.engine.trainer import Trainer

        if self.resume and self.overwrite:
            raise InputError("--resume and --overwrite together", "one of them")
        overrides = list(self.set)
        if self.steps is not None:
            overrides.append(f"schedule.steps={self.steps}")
        if self.renderer is not None:
            overrides.append(f"renderer.name={self.renderer}")
        device = choose_device(self.device)
        short = method_name(self.method).rsplit("/", maxsplit=1)[-1]
        scene_name = self.data.resolve().name
        if self.output is not None:
            run = RunFolder(self.output)
        else:
            run = RunFolder.newest(scene_name, short) if self.resume else RunFolder.default(scene_name, short)
        if self.resume:
            run = RunFolder.existing(run.path)
            method = resumed_method(run, self.method, self.data, overrides, self.format)
            seed = resumed_seed(run, self.seed)
        else:
            run.check_free(self.overwrite)
            method = load_method_for(self.data, self.method, overrides, self.format)
            seed = self.seed or 0
        scene = load_scene(method.config, self.data)
        trainer = Trainer(method, scene, str(self.data.resolve()), run, seed, device)
        logging.getLogger(__name__).info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
        if self.resume:
            trainer.resume()
        else:
            trainer.start(self.overwrite)
        trainer.train()
        print(run.path)
