"""What the evaluation of one test set collects, frame by frame."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.render_output import OPAQUE_ALPHA
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.scoring import Scorer, Scores, within_seen
from coliags_plugin.results.hashing import ArraysHash
from coliags_plugin.results.profiles import ErrorProfiles
from coliags_plugin.results.record import SEEN_SUFFIX, SetRecord

#: Metrics that are also computed over pixels seen by a training frame, where frames have a seen mask.
SEEN_METRICS = ("psnr", "ssim", "depth_mse", "depth_median_error")


class EvaluatedSet:
    """Scores, error profiles and hashes of one test set."""

    def __init__(self) -> None:
        self._rows: dict[str, dict[str, float]] = {}
        self._reasons: dict[str, str] = {}
        self._predictions, self._truth = ArraysHash(), ArraysHash()
        self._profiles = ErrorProfiles()
        self._optional: tuple[str, ...] = ()
        self._pixels = self._transparent = 0

    def add(self, frame: Frame, comparison: Comparison, scorer: Scorer, alpha: Float[Tensor, "H W"]) -> None:
        """Score a frame under its protocol and take it up, with its rendered alpha."""
        self._pixels += int(frame.valid.sum())
        self._transparent += int(((alpha < OPAQUE_ALPHA) & frame.valid).sum())
        self._add_scores(frame.name, scorer.score(comparison))
        self._optional = tuple(scorer.optional_metrics)
        if frame.seen is not None:
            self._add_scores(frame.name, scorer.score(within_seen(comparison, frame), SEEN_METRICS), SEEN_SUFFIX)
        predicted = {"rgb": comparison.rgb, "depth": comparison.depth}
        true = {
            "rgb": comparison.true_rgb,
            "valid": comparison.valid,
            "depth": comparison.true_depth,
            "depth_valid": comparison.depth_valid,
            "seen": frame.seen,
        }
        _hash(self._predictions, frame.name, predicted)
        _hash(self._truth, frame.name, true)
        self._profiles.add(comparison, frame)

    def _add_scores(self, frame: str, scores: Scores, suffix: str = "") -> None:
        row = self._rows.setdefault(frame, {})
        row.update({name + suffix: value for name, value in scores.values.items()})
        for name, reason in scores.reasons.items():
            self._reasons.setdefault(name + suffix, reason)

    @property
    def seen_metrics(self) -> list[str]:
        """Names of the metrics over seen pixels that some frame has."""
        return [name + SEEN_SUFFIX for name in SEEN_METRICS if name + SEEN_SUFFIX in self._scored]

    @property
    def optional_metrics(self) -> list[str]:
        """Names of the protocol's optional metrics that some frame has."""
        return [name for name in self._optional if name in self._scored]

    @property
    def _scored(self) -> set[str]:
        return {name for row in self._rows.values() for name in row}

    def record(self, metrics: Iterable[str]) -> SetRecord:
        """The set's record; the protocol's ``metrics`` are listed even where no frame has one."""
        rows = self._rows.values()
        lacking = set(self._optional) - set(self.optional_metrics)
        names = [*metrics, *self.optional_metrics, *self.seen_metrics]
        return SetRecord(
            frames=tuple(self._rows),
            values={name: tuple(row.get(name) for row in rows) for name in names},
            reasons={name: reason for name, reason in self._reasons.items() if name not in lacking},
            predictions_sha256=self._predictions.hexdigest(),
            truth_sha256=self._truth.hexdigest(),
            profiles=self._profiles.records(),
            transparent=self._transparent / self._pixels if self._pixels else None,
        )


def _hash(target: ArraysHash, frame: str, parts: dict[str, torch.Tensor | None]) -> None:
    for name, values in parts.items():
        if values is not None:
            target.add(frame, name, values.detach().cpu().numpy())
