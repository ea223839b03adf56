"""Adam per parameter group, with the rates a method config gives."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.contracts import Field, log_linear
from coliags_plugin.core.errors import InputError

#: Everywhere in the splatting lineage (docs/methods.md 2.3).
ADAM_EPSILON = 1e-15


class Optimizers:
    """One Adam per group of the field.

    Args:
        field: Whose parameters to train.
        settings: Rates by group name; must name exactly the field's groups.
        steps: Over which scheduled rates fall.
        extent: The scene's, for groups whose rates scale with it, scene units.

    Raises:
        InputError: The groups named are not the field's.
    """

    def __init__(self, field: Field, settings: Mapping[str, OptimizerSettings], steps: int, extent: float) -> None:
        groups = field.parameter_groups()
        if set(groups) != set(settings):
            raise InputError(
                f"optimizers names the groups {', '.join(sorted(settings))}",
                f"exactly the field's: {', '.join(sorted(groups))}",
            )
        self.settings = settings
        self.steps = steps
        self.extent = extent
        self.adam: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.Adam(parameters, lr=0.0, eps=ADAM_EPSILON, fused=True)
            for name, parameters in groups.items()
        }

    def rate(self, name: str, step: int) -> float:
        """The learning rate of a group at a step, counted from 1."""
        group = self.settings[name]
        rate = group.lr if group.final_lr is None else log_linear(group.lr, group.final_lr, step / self.steps)
        return rate * self.extent if group.times_extent else rate

    def step(self, step: int) -> None:
        """Take one step with every group and clear the gradients."""
        for name, optimizer in self.adam.items():
            for group in optimizer.param_groups:
                group["lr"] = self.rate(name, step)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
