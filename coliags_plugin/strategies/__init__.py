"""Strategies: growing, splitting and pruning between optimiser steps."""

from __future__ import annotations

from typing import ClassVar

from coliags_plugin.contracts import Strategy


class NoStrategy(Strategy):
    """Strategy that neither grows nor prunes."""

    serves: ClassVar[frozenset[str] | None] = None

    def plan(self) -> str:
        """The sentence for the log: no growing, no pruning."""
        return "this run neither grows nor prunes: strategy none"
