"""``coliags eval``: evaluate a run on its held-out frames."""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import coliags, print_summary


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate a run on its held-out frames under a protocol."""

    path: arguments.RunFolder
    protocol: arguments.OptionalText = None
    """Protocol by name (`coliags list protocols`); default: the method config's."""
    truth: arguments.OptionalPath = None
    """A scene of the same frames and poses with true depth, to evaluate against instead of the run's own, for runs
    trained on estimated depth; results go into eval/PROTOCOL-truth."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    json: arguments.AsJson = False

    def run(self) -> None:
        """Evaluate and print a table."""
        from coliags_plugin.api.runs import load_run
        from coliags_plugin.results.summaries import means_summary

        run = load_run(self.path, data=self.data, device=self.device)
        result = run.evaluate(self.protocol, truth=self.truth)
        name = result.evaluation_name
        shown = () if name == "paper" else ("--protocol", name)
        print_summary(
            str(result),
            means_summary(result),
            written=[run.folder.evaluations / name / "metrics.json"],
            then=[coliags("report", self.path, *shown)],
            as_json=self.json,
        )
