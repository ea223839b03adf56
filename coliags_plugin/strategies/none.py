"""Strategy that does not change the field."""

from __future__ import annotations

from typing import ClassVar

from coliags_plugin.contracts import Strategy
from coliags_plugin.core.settings import Settings


class NoStrategySettings(Settings):
    """No options."""


class NoStrategy(Strategy[NoStrategySettings]):
    """Neither grows nor prunes."""

    Settings: ClassVar[type[Settings]] = NoStrategySettings
    serves: ClassVar[frozenset[str] | None] = None

    def plan(self) -> str:
        """The sentence for the log: no growing, no pruning."""
        return "this run neither grows nor prunes: strategy none"
