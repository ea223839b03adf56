"""Scores of single views under a protocol."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from coliags_plugin.config import registry
from coliags_plugin.config.components import named_component
from coliags_plugin.contracts import Comparison, Metric, Protocol
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.model import Model


@dataclass(frozen=True)
class Scores:
    """Scores of one view by name, and the reasons why others cannot be had."""

    values: dict[str, float] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


class Scorer:
    """Renders held-out views and scores them under the protocol of a name, by all its metrics or only some."""

    def __init__(self, protocol: str, only: Sequence[str] | None = None) -> None:
        self.protocol: Protocol = registry.protocols.get(protocol)()
        if self.protocol.name != protocol:
            raise InputError(
                f"protocol '{protocol}' from {registry.protocols.source(protocol)} has the name '{self.protocol.name}'",
                "the name that it is registered under",
            )
        self.wants = tuple(sorted({"rgb", "alpha"} | self.protocol.wants))
        self.metrics = self._made(self.protocol.metrics, only)
        self.optional_metrics = self._made(self.protocol.optional_metrics, only)

    def _made(
        self, table: Mapping[str, tuple[str, Mapping[str, Any]]], only: Sequence[str] | None
    ) -> dict[str, Metric]:
        made = {}
        for key, (name, options) in table.items():
            if only is None or key in only:
                asking = f"protocol '{self.protocol.name}', metric '{key}'"
                component = named_component("metrics", {"name": name, **options}, asking)
                made[key] = component.target(component.settings)
        return made

    @torch.no_grad()
    def render(self, model: Model, frame: Frame) -> RenderOutput:
        """Render a held-out frame, which is on the model's device.

        The outputs are those that the protocol compares and, if the renderer has it, accumulated depth for pictures.
        """
        wants = sorted({*self.wants} | ({"depth_accumulated"} & model.outputs))
        return model.render(frame.camera, wants, frame.view(trained=False))

    def compare(self, model: Model, frame: Frame, device: torch.device) -> Comparison:
        """Render a held-out frame for comparison with its ground truth."""
        placed = frame.to(device)
        return self.protocol.compare(self.render(model, placed), placed)

    def score(self, comparison: Comparison, names: Sequence[str] | None = None) -> Scores:
        """Every metric of a view, or those named among them."""
        scores = Scores()
        for name, metric in (self.metrics | self.optional_metrics).items():
            if names is not None and name not in names:
                continue
            try:
                value = metric(comparison)
            except UnavailableError as error:
                scores.reasons[name] = str(error)
                continue
            if math.isfinite(value):
                scores.values[name] = value
            else:
                scores.reasons[name] = f"the metric is {value}"
        return scores


def within_seen(comparison: Comparison, frame: Frame) -> Comparison:
    """A comparison restricted to pixels that a training frame sees, where the frame has a seen mask."""
    if frame.seen is None:
        return comparison
    seen = frame.seen.to(comparison.valid.device)
    depth_valid = None if comparison.depth_valid is None else comparison.depth_valid & seen
    return replace(comparison, valid=comparison.valid & seen, depth_valid=depth_valid)
