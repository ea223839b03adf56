"""What the evaluation of a run collects frame by frame, and the result that is composed of it."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.render_output import OPAQUE_ALPHA
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine.checkpoints import checkpoint_folder
from coliags_plugin.engine.costs import RenderMeter, TrainingCost, seconds_to_psnr
from coliags_plugin.engine.devices import device_name
from coliags_plugin.engine.provenance import software
from coliags_plugin.engine.scoring import Scorer, Scores, within_seen
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.truth import Truth
from coliags_plugin.results.hashing import ArraysHash, code_key, metrics_sha256, plain_config, result_key
from coliags_plugin.results.profiles import ErrorProfiles
from coliags_plugin.results.record import (
    REFINED_METRICS,
    REFINED_SUFFIXES,
    SEEN_SUFFIX,
    CostRecord,
    MetricRecord,
    ProtocolRecord,
    Result,
    SceneRecord,
    SetRecord,
)

#: Metrics that are also computed over pixels seen by a training frame, where frames have a seen mask.
SEEN_METRICS = ("psnr", "psnr_gain_fitted", "ssim", "depth_mse", "depth_median_error")

#: Keys of the provenance of a run and of its scene that a result has in another place.
_LEFT_OUT = ("method", "seed", "steps", "scene", "untrained_views", "fingerprint", "held_out_used")


def further_metrics(scorer: Scorer) -> dict[str, Metric]:
    """Metrics that only some frames have, by name and in order.

    Those are the protocol's optional ones, those over seen pixels, and those from refined poses.
    """
    known = scorer.metrics | scorer.optional_metrics
    named = {name + SEEN_SUFFIX: name for name in SEEN_METRICS}
    named |= {name + suffix: name for suffix, name in product(REFINED_SUFFIXES, REFINED_METRICS)}
    return scorer.optional_metrics | {name: known[base] for name, base in named.items() if base in known}


class EvaluatedSet:
    """Scores, error profiles and hashes of one test set of a scene, whose unit of length is printed as ``unit``."""

    def __init__(self, unit: str, scorer: Scorer) -> None:
        self._scorer = scorer
        self._rows: dict[str, dict[str, float]] = {}
        self._reasons: dict[str, str] = {}
        self._predictions, self._truth = ArraysHash(), ArraysHash()
        self._profiles = ErrorProfiles(unit)
        self._pixels = self._transparent = 0

    def add(self, frame: Frame, comparison: Comparison, alpha: Float[Tensor, "H W"]) -> None:
        """Score a frame under its protocol and take it up, with its rendered alpha."""
        self._pixels += int(frame.valid.sum())
        self._transparent += int(((alpha < OPAQUE_ALPHA) & frame.valid).sum())
        self.add_scores(frame.name, self._scorer.score(comparison))
        if frame.seen is not None:
            self.add_scores(frame.name, self._scorer.score(within_seen(comparison, frame), SEEN_METRICS), SEEN_SUFFIX)
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

    def add_scores(self, frame: str, scores: Scores, suffix: str = "") -> None:
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
        names = [*self._scorer.metrics, *(name for name in further_metrics(self._scorer) if name in scored)]
        lacking = self._scorer.optional_metrics.keys() - scored
        return SetRecord(
            frames=tuple(self._rows),
            values={name: tuple(row.get(name) for row in rows) for name in names},
            reasons={name: reason for name, reason in self._reasons.items() if name not in lacking},
            predictions_sha256=self._predictions.hexdigest(),
            truth_sha256=self._truth.hexdigest(),
            profiles=self._profiles.records(),
            transparent=self._transparent / self._pixels if self._pixels else None,
        )


def _hash(target: ArraysHash, frame: str, **parts: Tensor | None) -> None:
    for name, values in parts.items():
        if values is not None:
            target.add(frame, name, values.detach().cpu().numpy())


def run_result(
    trained: TrainedRun,
    scorer: Scorer,
    evaluated: Mapping[str, EvaluatedSet],
    meter: RenderMeter,
    truth: Truth | None = None,
) -> Result:
    """Compose the result of a run from its test sets, at least one, and what rendering them cost.

    ``truth`` is what it was evaluated against, if not its own scene.
    """
    protocol, provenance = scorer.protocol, trained.provenance
    config = plain_config(trained.config.model_dump())
    data = trained.scene if truth is None else truth.scene
    sets = {name: part.record() for name, part in evaluated.items()}
    scored = {name for part in evaluated.values() for name in part.scored}
    metrics = scorer.metrics | {name: each for name, each in further_metrics(scorer).items() if name in scored}
    deviations = _deviations(trained.step, config["schedule"]["steps"], provenance)
    if truth is not None:
        deviations["truth"] = data.provenance.get("fingerprint")
    if any(name.endswith(REFINED_SUFFIXES) for name in scored):
        deviations["refined"] = list(REFINED_SUFFIXES)
    return Result(
        key=result_key(
            config,
            str(trained.scene.provenance.get("fingerprint", "")),
            trained.seed,
            code_key(),
            protocol.name,
            protocol.version,
            deviations,
        ),
        method=trained.method,
        scene=_scene_record(data),
        protocol=ProtocolRecord(name=protocol.name, version=protocol.version, description=protocol.description),
        seed=trained.seed,
        steps=trained.step,
        metrics={
            name: MetricRecord(
                unit=metric.unit.replace("mm", data.length_unit),
                direction="higher" if metric.higher_is_better else "lower",
            )
            for name, metric in metrics.items()
        },
        sets=sets,
        metrics_sha256=metrics_sha256(sets),
        cost=_cost(trained, meter),
        config=config,
        software=software(),
        provenance={
            "untrained_views": {name: part.untrained_views for name, part in trained.model.view_modules.items()},
            "training": {name: value for name, value in provenance.items() if name not in _LEFT_OUT},
            "scene": {name: value for name, value in data.provenance.items() if name not in _LEFT_OUT},
            **({"held_out_used": used} if (used := trained.scene.provenance.get("held_out_used")) else {}),
            **({"learned": learned} if (learned := trained.model.learned) else {}),
            **({} if truth is None else {"truth": _described(truth, trained.scene)}),
        },
    )


def _described(truth: Truth, own: Scene) -> JsonObject:
    trained_on = {"name": own.name, **{key: own.provenance.get(key) for key in ("dataset", "unit", "fingerprint")}}
    return {"scene": truth.scene.name, "matched_by": truth.matched_by, "trained_on": trained_on}


def _scene_record(scene: Scene) -> SceneRecord:
    """The record of a scene that has a test frame."""
    split = scene.provenance.get("split", "")
    camera = next(frame for frames in scene.test_sets.values() for frame in frames).camera
    return SceneRecord(
        name=scene.name,
        fingerprint=str(scene.provenance.get("fingerprint", "")),
        split=str(split.get("name", "") if isinstance(split, Mapping) else split),
        train=tuple(frame.name for frame in scene.train),
        size=(camera.width, camera.height),
    )


def _cost(trained: TrainedRun, meter: RenderMeter) -> CostRecord:
    rows = trained.run.log_rows(trained.step)
    training = trained.cost or TrainingCost(device=str(trained.provenance["device"]))  # of a run that was imported
    checkpoint = checkpoint_folder(trained.run.checkpoints, trained.step)
    return CostRecord(
        device=training.device,
        threads=training.threads,
        train_seconds=training.seconds,
        processor_seconds=training.processor_seconds,
        peak_memory_mib=training.peak_memory_mib,
        render_fps=meter.fps,
        render_device=device_name(trained.device),
        render_threads=torch.get_num_threads(),
        gaussians=meter.gaussians,
        checkpoint_bytes=sum(file.stat().st_size for file in checkpoint.glob("*")) or None,
        seconds_to_psnr=seconds_to_psnr(rows, len(trained.scene.train)),
    )


def _deviations(step: int, configured: int, provenance: Mapping[str, Any]) -> JsonObject:
    """How a run differs from one that goes through as configured, with this code; empty where it does not."""
    lengths = ("steps", "written_for")
    jumps = [
        change
        for change in provenance.get("schedule_changes", [])
        if any(change["from"][name] != change["to"][name] for name in lengths)
    ]
    trained_with = provenance.get("code", code_key())
    return {
        **({} if step == configured else {"step": step}),
        **({"schedule_changes": jumps} if jumps else {}),
        **({} if trained_with == code_key() else {"trained_with": trained_with}),
        **({"code_changes": provenance["code_changes"]} if "code_changes" in provenance else {}),
    }
