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
        import json

        from rich.console import Console

        from coliags_plugin.engine.backends import choose_device
        from coliags_plugin.engine.evaluator import evaluate
        from coliags_plugin.engine.trained import load_trained
        from coliags_plugin.reporting.metrics_table import metrics_table

        trained = load_trained(self.path, choose_device(self.device), self.data)
        folder = evaluate(trained, self.protocol or trained.config.protocol)
        summary = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        Console().print(metrics_table(summary))
        for reason in dict.fromkeys(summary["reasons"].values()):
            names = [name for name, text in summary["reasons"].items() if text == reason]
            print(f"{', '.join(names)}: {reason}")
        print(folder / "metrics.json")
