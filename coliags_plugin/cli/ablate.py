"""``coliags ablate``: train and evaluate the variants of a method on several scenes."""

from __future__ import annotations

from dataclasses import dataclass

import tyro

from coliags_plugin.cli.comparison_arguments import ComparisonArguments


@dataclass(frozen=True, kw_only=True)
class AblateCommand(ComparisonArguments):
    """Train and evaluate the variants that a file names on scenes; otherwise as compare."""

    file: tyro.conf.Positional[str]
    """Name of an ablation (`coliags list ablations`) or path of a YAML file."""

    def run(self) -> None:
        """Compare the variants and print a summary."""
        from coliags_plugin.comparison.ablations import load_ablation

        self.carry_out(load_ablation(self.file))
