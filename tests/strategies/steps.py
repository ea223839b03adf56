"""Single training steps for strategies, without a renderer."""

from __future__ import annotations

import torch

from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.contracts import TrainingStep
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.optimizers import Optimizers


def stepped_optimizers(field, lr):
    """Optimizers of a field that have taken one step along random gradients, which are still there."""
    settings = {name: OptimizerSettings(lr=lr) for name in field.parameter_groups()}
    rows = Optimizers(Model(field, None, {}), settings, 100, 1.0)
    for optimizer in rows.adam.values():
        for parameter in optimizer.param_groups[0]["params"]:
            parameter.grad = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
        optimizer.param_groups[0]["lr"] = lr
        optimizer.step()
    return rows


def after_backward(strategy, step, field, rows, output):
    """What a strategy does after ``backward`` of a step with this output."""
    return strategy.after_backward(TrainingStep(output, None, rows.model, step, strategy.schedule), rows)
