"""``coliags eval``: evaluate a run on its held-out frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import OptionalPath, OptionalText


@dataclass(frozen=True)
class Evaluate:
    """Evaluate a run on its held-out frames under a protocol."""

    path: tyro.conf.Positional[Path]
    """Run folder."""
    protocol: OptionalText = None
    """Protocol by name (`coliags list protocols`); default: the method config's."""
    data: OptionalPath = None
    """The scene's folder, where it has moved since training."""
    truth: OptionalPath = None
    """A scene of the same frames and poses with true depth, to evaluate against instead of the run's own, for runs
    trained on estimated depth; results go into eval/PROTOCOL-truth."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""

    def run(self) -> None:
        """Evaluate, print a table, and print the path of the metrics."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        result = run.evaluate(self.protocol, truth=self.truth)
        print(result)
        print(run.folder.evaluations / result.evaluation_name / "metrics.json")
