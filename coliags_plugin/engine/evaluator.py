"""Evaluation of a run's held-out views under one protocol."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.contracts import Comparison, Metric, Protocol
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_write, write_json
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.provenance import software
from coliags_plugin.engine.scoring import Scorer, Scores, within_seen
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.outputs.colormaps import DEPTH_ERROR_LIMIT_MM, colorize_depth_error
from coliags_plugin.outputs.image_files import eight_bit, write_depth_tiff, write_png

#: The main test set, whose means are at the top of metrics.json.
MAIN_SET = "test"
#: Metrics that are also computed over pixels seen by a training frame, where frames have a seen mask.
SEEN_METRICS = ("psnr", "ssim", "depth_mse", "depth_median_error")
SEEN_SUFFIX = "_seen"


@dataclass
class _SetScores:
    """Per-frame metrics of one test set, and reasons for missing ones."""

    rows: dict[str, dict[str, float]] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)

    def add(self, frame: str, scores: Scores, suffix: str = "") -> None:
        """Add the metrics of one frame, and reasons for missing ones."""
        row = self.rows.setdefault(frame, {})
        row.update({name + suffix: value for name, value in scores.values.items()})
        for name, reason in scores.reasons.items():
            self.reasons.setdefault(name + suffix, reason)

    def means(self, names: list[str]) -> dict[str, float | None]:
        """Mean over the frames that have a metric; None where none has."""
        found: dict[str, float | None] = {}
        for name in names:
            values = [row[name] for row in self.rows.values() if name in row]
            found[name] = sum(values) / len(values) if values else None
        return found


def evaluate(trained: TrainedRun, protocol_name: str) -> Path:
    """Render every held-out view, compute the protocol's metrics, and write them with the images.

    Writes ``eval/<protocol>/metrics.json`` (means per test set; the main set's also at the top; null where a metric
    is not available, with the reason), ``per_frame.csv`` and the images. An earlier evaluation under the same protocol
    is replaced once the new one is complete.

    Returns:
        The evaluation's folder.

    Raises:
        InputError: The protocol is unknown or wants what the renderer cannot deliver, there is no test frame, or the
            run was relit.
    """
    if trained.lamp is not None:
        raise InputError(
            "evaluation of a relit run", "the lamp that the data were recorded with", "Evaluate the run as loaded"
        )
    scorer = Scorer(protocol_name)
    trained.model.check_outputs(scorer.wants, f"protocol '{protocol_name}'")
    sets = {name: frames for name, frames in trained.scene.test_sets.items() if frames}
    if not sets:
        raise InputError(f"scene '{trained.scene.name}' has no test frames", "a split that holds some out")
    total, done = sum(map(len, sets.values())), 0
    target = trained.run.evaluation(scorer.protocol.name)
    scores = {name: _SetScores() for name in sets}
    with atomic_folder(target, overwrite=True) as scratch, ProgressReport("evaluate", total) as progress:
        for set_name, frames in sets.items():
            for frame in frames:
                comparison = scorer.compare(trained.model, frame, trained.device)
                _add_scores(scores[set_name], frame, scorer, comparison)
                _write_images(scratch, set_name, frame, comparison)
                done += 1
                progress.update(done)
        write_json(scratch / "metrics.json", _summary(trained, scorer.protocol, scorer.metrics, scores))
        atomic_write(scratch / "per_frame.csv", _table(scores, _columns(scorer.metrics, scores)))
    return target


def _add_scores(scores: _SetScores, frame: Frame, scorer: Scorer, comparison: Comparison) -> None:
    scores.add(frame.name, scorer.score(comparison))
    if frame.seen is not None:
        scores.add(frame.name, scorer.score(within_seen(comparison, frame), SEEN_METRICS), SEEN_SUFFIX)


def _write_images(folder: Path, set_name: str, frame: Frame, comparison: Comparison) -> None:
    name = f"{set_name}/{frame.name}"
    write_png(folder / "renders" / f"{name}.png", eight_bit(comparison.rgb))
    write_png(folder / "truth" / f"{name}.png", frame.image)
    if comparison.depth is None or comparison.true_depth is None or comparison.depth_valid is None:
        return
    known = torch.where(comparison.depth_valid, comparison.true_depth, torch.nan)
    write_depth_tiff(folder / "depth" / f"{name}.tiff", comparison.depth)
    write_depth_tiff(folder / "true_depth" / f"{name}.tiff", known)
    errors = colorize_depth_error(comparison.depth, known, comparison.depth_valid, DEPTH_ERROR_LIMIT_MM)
    write_png(folder / "errors" / f"{name}.png", errors)


def _columns(metrics: Mapping[str, Metric], scores: Mapping[str, _SetScores]) -> list[str]:
    seen = {name for part in scores.values() for row in part.rows.values() for name in row if name not in metrics}
    return [*metrics, *(name + SEEN_SUFFIX for name in SEEN_METRICS if name + SEEN_SUFFIX in seen)]


def _summary(
    trained: TrainedRun, protocol: Protocol, metrics: Mapping[str, Metric], scores: Mapping[str, _SetScores]
) -> dict[str, Any]:
    columns = _columns(metrics, scores)
    base = {name: name.removesuffix(SEEN_SUFFIX) for name in columns}
    main = scores.get(MAIN_SET) or next(iter(scores.values()))
    reasons = {name: text for part in [*scores.values()][::-1] for name, text in part.reasons.items()}
    return {
        "protocol": {"name": protocol.name, "version": protocol.version, "description": protocol.description},
        "method": trained.method,
        "scene": trained.scene.name,
        "step": trained.step,
        "untrained_views": {name: module.untrained_views for name, module in trained.model.view_modules.items()},
        **main.means(list(metrics)),
        "reasons": reasons,
        "directions": {name: "higher" if metrics[base[name]].higher_is_better else "lower" for name in columns},
        "units": {name: metrics[base[name]].unit for name in columns},
        "sets": {name: {"frames": len(part.rows), **part.means(columns)} for name, part in scores.items()},
        "software": software(),
    }


def _table(scores: Mapping[str, _SetScores], columns: list[str]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["set", "frame", *columns])
    for set_name, part in scores.items():
        for frame, row in part.rows.items():
            writer.writerow([set_name, frame, *(repr(row[name]) if name in row else "" for name in columns)])
    return text.getvalue()
