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
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""

    def run(self) -> None:
        """Evaluate, print a table, and print the path of the metrics."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        result = run.evaluate(self.protocol)
        print(result)
        print(run.folder.evaluation(result.protocol.name) / "metrics.json")
