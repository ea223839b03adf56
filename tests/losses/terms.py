"""Losses on a hand-made output and frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from coliags_plugin.contracts import Loss, Schedule, TrainingStep
from coliags_plugin.core import registry
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import RenderOutput, Splats


def step(output, target=None, model=None, number=1, schedule=None):
    """A training step; the only one of its run without a number and a schedule."""
    return TrainingStep(output, target, model, number, schedule or Schedule(number, number))


@dataclass(frozen=True)
class Term:
    """A loss that is given an output and a frame."""

    loss: Loss

    def __call__(self, output, frame):
        return self.loss(step(output, frame.target))


def make(name, **options):
    loss = registry.losses.get(name)
    return Term(loss(loss.Settings(weight=1.0, **options)))


def make_output(rgb, scales=None, alpha=None, **maps):
    """A RenderOutput of these colours, scales, alpha and maps."""
    scales = torch.zeros(0, 3) if scales is None else scales
    count = len(scales)
    gaussians = Gaussians(
        torch.zeros(count, 3), torch.zeros(count, 4), scales, torch.ones(count), torch.zeros(count, 3),
        torch.arange(count), torch.arange(count),
    )  # fmt: skip
    splats = Splats(gaussians, torch.zeros(count, 2), torch.zeros(count))
    return RenderOutput(rgb, torch.ones(rgb.shape[:2]) if alpha is None else alpha, None, maps, splats)
