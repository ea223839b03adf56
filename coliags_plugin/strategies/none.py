"""The strategy that leaves the field as it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from coliags_plugin.contracts import Strategy
from coliags_plugin.core.gaussians import RenderOutput
from coliags_plugin.core.settings import Settings


class NoStrategySettings(Settings):
    """No options."""


class NoStrategy(Strategy):
    """Neither grows nor prunes."""

    Settings: ClassVar[type[Settings]] = NoStrategySettings

    def plan(self) -> str:
        """The sentence for the log: no growing, no pruning."""
        return "this run neither grows nor prunes: strategy none"

    def after_backward(
        self, step: int, field: Any, optimizers: Mapping[str, torch.optim.Optimizer], output: RenderOutput
    ) -> dict[str, int]:
        """Do nothing."""
        return {}
