"""Losses on a hand-made output and frame."""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.config import registry
from coliags_plugin.contracts import Loss, Schedule, TrainingStep


@dataclass(frozen=True)
class Term:
    """A loss that is given an output and a frame."""

    loss: Loss

    def __call__(self, output, frame):
        return self.loss(TrainingStep(output, frame.target, None, 1, Schedule(1, 1)))


def make(name, **options):
    loss = registry.losses.get(name)
    return Term(loss(loss.Settings(weight=1.0, **options)))
