"""Scores of views under a protocol: of single ones, and those of a test set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.config import registry
from coliags_plugin.config.components import named_component
from coliags_plugin.contracts import Comparison, Metric, Protocol
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.render_output import BLANK_ALPHA, OPAQUE_ALPHA, RenderOutput
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.pose_refinement import color_factors, refined_camera
from coliags_plugin.results.hashing import ArraysHash
from coliags_plugin.results.profiles import ErrorProfiles
from coliags_plugin.results.record import REFINED_METRICS, REFINED_SUFFIXES, SEEN_SUFFIX, SetRecord


@dataclass(frozen=True)
class Scores:
    """Scores of one view by name, and the reasons why others cannot be had."""

    values: dict[str, float] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


#: Metrics that are also computed over pixels seen by a training frame, where frames have a seen mask.
SEEN_METRICS = ("psnr", "psnr_gain_fitted", "ssim", "depth_mse", "depth_median_error")


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
        metrics = {}
        for key, (name, options) in table.items():
            if only is None or key in only:
                asking = f"protocol '{self.protocol.name}', metric '{key}'"
                component = named_component("metrics", {"name": name, **options}, asking)
                metrics[key] = component.target(component.settings)
        return metrics

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

    def refined(self, model: Model, frame: Frame) -> tuple[Comparison, Comparison]:
        """A frame, on the model's device, from its refined pose, as it is rendered, and with its colours fitted."""
        moved = replace(frame, camera=refined_camera(model, frame))
        view = self.compare(model, moved, frame.image.device)
        factors = color_factors(view.rgb, view.true_rgb, view.valid)
        return view, replace(view, rgb=(view.rgb * factors).clamp(0.0, 1.0))

    @property
    def further_metrics(self) -> dict[str, Metric]:
        """Metrics that only some frames have: optional ones, those over seen pixels, and those from refined poses."""
        metrics = self.metrics | self.optional_metrics
        named = {name + SEEN_SUFFIX: name for name in SEEN_METRICS}
        named |= {name + suffix: name for suffix, name in product(REFINED_SUFFIXES, REFINED_METRICS)}
        return self.optional_metrics | {name: metrics[base] for name, base in named.items() if base in metrics}


class EvaluatedSet:
    """Scores, error profiles and hashes of one test set of a scene, whose unit of length is printed as ``unit``.

    ``scale`` is that of lengths in training.
    """

    def __init__(self, unit: str, scorer: Scorer, scale: float = 1.0) -> None:
        self._scorer = scorer
        self._rows: dict[str, dict[str, float]] = {}
        self._reasons: dict[str, str] = {}
        self._predictions, self._truth = ArraysHash(), ArraysHash()
        self._profiles = ErrorProfiles(unit, scale)
        self._pixels = self._transparent = self._blank = 0

    def add(self, frame: Frame, comparison: Comparison, alpha: Float[Tensor, "H W"], *refined: Comparison) -> None:
        """Score a frame under its protocol and take it up, with its rendered alpha, and views from a refined pose."""
        self._pixels += int(frame.valid.sum())
        self._transparent += int(((alpha < OPAQUE_ALPHA) & frame.valid).sum())
        self._blank += shows_nothing(alpha, frame)
        self._add_scores(frame.name, self._scorer.score(comparison))
        if frame.seen is not None:
            self._add_scores(frame.name, self._scorer.score(within_seen(comparison, frame), SEEN_METRICS), SEEN_SUFFIX)
        for suffix, view in zip(REFINED_SUFFIXES, refined, strict=False):
            self._add_scores(frame.name, self._scorer.score(view, REFINED_METRICS), suffix)
        _hash(self._predictions, frame.name, rgb=comparison.rgb, depth=comparison.depth)
        _hash(
            self._truth,
            frame.name,
            rgb=comparison.true_rgb,
            valid=comparison.valid,
            depth=comparison.true_depth,
            depth_valid=comparison.depth_valid,
            seen=frame.seen,
        )
        self._profiles.add(comparison, frame)

    def _add_scores(self, frame: str, scores: Scores, suffix: str = "") -> None:
        """Take up scores of a frame, under names with a suffix."""
        row = self._rows.setdefault(frame, {})
        row.update({name + suffix: value for name, value in scores.values.items()})
        for name, reason in scores.reasons.items():
            self._reasons.setdefault(name + suffix, reason)

    @property
    def scored(self) -> set[str]:
        """Names of the metrics that some frame has."""
        return {name for row in self._rows.values() for name in row}

    def record(self) -> SetRecord:
        """The set's record; the protocol's metrics are listed even where no frame has one."""
        rows, scored = self._rows.values(), self.scored
        names = [*self._scorer.metrics, *(name for name in self._scorer.further_metrics if name in scored)]
        lacking = self._scorer.optional_metrics.keys() - scored
        return SetRecord(
            frames=tuple(self._rows),
            values={name: tuple(row.get(name) for row in rows) for name in names},
            reasons={name: reason for name, reason in self._reasons.items() if name not in lacking},
            predictions_sha256=self._predictions.hexdigest(),
            truth_sha256=self._truth.hexdigest(),
            profiles=self._profiles.records(),
            transparent=self._transparent / self._pixels if self._pixels else None,
            blank=self._blank,
        )


def shows_nothing(alpha: Float[Tensor, "H W"], frame: Frame) -> bool:
    """Return True if a view is blank: its mean alpha within the frame's mask is below :data:`BLANK_ALPHA`."""
    return bool(frame.valid.any() and alpha[frame.valid].mean() < BLANK_ALPHA)


def _hash(target: ArraysHash, frame: str, **parts: Tensor | None) -> None:
    for name, values in parts.items():
        if values is not None:
            target.add(frame, name, values.detach().cpu().numpy())


def within_seen(comparison: Comparison, frame: Frame) -> Comparison:
    """A comparison restricted to pixels that a training frame sees, where the frame has a seen mask."""
    if frame.seen is None:
        return comparison
    mask = frame.seen.to(comparison.valid.device)
    depth_valid = None if comparison.depth_valid is None else comparison.depth_valid & mask
    return replace(comparison, valid=comparison.valid & mask, depth_valid=depth_valid)
