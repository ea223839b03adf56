"""``coliags compare``: train and evaluate several methods on several scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from coliags_plugin.cli.comparison_arguments import ComparisonArguments


@dataclass(frozen=True, kw_only=True)
class CompareCommand(ComparisonArguments):
    """Train and evaluate methods on scenes; what is done is kept, and what was interrupted goes on.

    The same command goes on after any interruption. Exit status 1 if a cell failed; the others are done all the same.
    """

    methods: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="METHOD...")]
    """Names of methods (`coliags list methods`) or paths of YAML files."""

    def run(self) -> None:
        """Compare and print a summary."""
        self.carry_out(self.methods)
