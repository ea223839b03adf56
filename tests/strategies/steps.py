"""Single training steps for strategies, without a renderer."""

from __future__ import annotations

import torch

from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.contracts import TrainingStep
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput, Splats
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
    """Changes by a strategy after ``backward`` of a step with this output."""
    return strategy.after_backward(TrainingStep(output, None, rows.model, step, strategy.schedule), rows)


def make_output(slots, gradients, radii=None, visible=None, opacity=1.0, width=200, height=100):
    """Gaussians of these slots whose projected centres have these gradients along x, in normalised image units."""
    count = len(slots)
    means2d = torch.zeros(count, 2, requires_grad=True)
    means2d.grad = torch.stack([torch.as_tensor(gradients) / (0.5 * width), torch.zeros(count)], dim=1)
    sources = torch.as_tensor(slots, dtype=torch.long)
    none, opacities = torch.zeros(count, 3), torch.full((count,), opacity)
    seen = sources if visible is None else visible
    gaussians = Gaussians(none, torch.zeros(count, 4), none, opacities, none, sources, seen)
    image = torch.zeros(height, width)
    drawn = torch.ones(count) if radii is None else torch.as_tensor(radii)
    return RenderOutput(image[..., None].expand(-1, -1, 3), image, None, splats=Splats(gaussians, means2d, drawn))
