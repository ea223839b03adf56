"""Commands that make a run: ``coliags train``, ``import``."""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.cli.summaries import coliags, print_summary
from coliags_plugin.config import options


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
        from coliags_plugin.api.training import train

        run = train(self, view_port=self.port if self.view else None)
        facts = {"method": run.method, "scene": run.scene_name, "seed": run.seed, "step": run.step}
        print_summary(facts=facts, written=[run.path], then=[coliags("eval", run.path)], as_json=self.json)


@dataclass(frozen=True)
class ImportCommand(options.ImportOptions):
    """Make a run folder of anyone's file of 3D Gaussians, which eval, render, mesh and report take like any other."""

    json: options.AsJson = False

    def run(self) -> None:
        """Import, and print the run folder."""
        from coliags_plugin.api.training import import_splats

        run = import_splats(self)
        print_summary(written=[run.path], then=[coliags("eval", run.path)], as_json=self.json)
