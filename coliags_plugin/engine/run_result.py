"""The result of an evaluated run, composed of the run's folder, its scene and its scores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from coliags_plugin._version import __version__
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.checkpoints import checkpoint_folder
from coliags_plugin.engine.costs import RenderMeter, TrainingCost, seconds_to_psnr
from coliags_plugin.engine.devices import device_name
from coliags_plugin.engine.evaluated_set import SEEN_METRICS, EvaluatedSet
from coliags_plugin.engine.provenance import software
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.truth import Truth
from coliags_plugin.results.hashing import metrics_sha256, plain_config, result_key
from coliags_plugin.results.record import SEEN_SUFFIX, CostRecord, MetricRecord, ProtocolRecord, Result, SceneRecord

#: Keys of the provenance of a run and of its scene that a result has in another place, or that name a local path.
_LEFT_OUT = ("method", "seed", "steps", "scene", "untrained_views", "path", "fingerprint")


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
    sets = {name: part.record(scorer.metrics) for name, part in evaluated.items()}
    deviations = _deviations(trained.step, config["schedule"]["steps"], provenance)
    if truth is not None:
        deviations["truth"] = data.provenance.get("fingerprint")
    return Result(
        key=result_key(
            config,
            str(trained.scene.provenance.get("fingerprint", "")),
            trained.seed,
            __version__,
            protocol.name,
            protocol.version,
            deviations,
        ),
        method=trained.method,
        scene=scene_record(data),
        protocol=ProtocolRecord(name=protocol.name, version=protocol.version, description=protocol.description),
        seed=trained.seed,
        steps=trained.step,
        metrics=_metrics(scorer, evaluated, data.length_unit),
        sets=sets,
        metrics_sha256=metrics_sha256(sets),
        cost=_cost(trained, meter),
        config=config,
        software=software(),
        provenance={
            "untrained_views": {name: part.untrained_views for name, part in trained.model.view_modules.items()},
            "training": {name: value for name, value in provenance.items() if name not in _LEFT_OUT},
            "scene": {name: value for name, value in data.provenance.items() if name not in _LEFT_OUT},
            **({"learned": learned} if (learned := trained.model.learned) else {}),
            **({} if truth is None else {"truth": _described(truth, trained.scene)}),
        },
    )


def _described(truth: Truth, own: Scene) -> JsonObject:
    trained_on = {key: own.provenance.get(key) for key in ("dataset", "unit", "fingerprint")}
    return {
        "scene": truth.scene.name,
        "matched_by": truth.matched_by,
        "trained_on": {"name": own.name, **trained_on},
    }


def scene_record(scene: Scene) -> SceneRecord:
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


def _metrics(scorer: Scorer, evaluated: Mapping[str, EvaluatedSet], unit: str) -> dict[str, MetricRecord]:
    seen = {name for part in evaluated.values() for name in part.seen_metrics}
    optional = {name for part in evaluated.values() for name in part.optional_metrics}
    metrics = scorer.metrics | {name: metric for name, metric in scorer.optional_metrics.items() if name in optional}
    records = {
        name: MetricRecord(
            unit=metric.unit.replace("mm", unit), direction="higher" if metric.higher_is_better else "lower"
        )
        for name, metric in metrics.items()
    }
    over_seen = {name + SEEN_SUFFIX: records[name] for name in SEEN_METRICS if name + SEEN_SUFFIX in seen}
    return records | over_seen


def _cost(trained: TrainedRun, meter: RenderMeter) -> CostRecord:
    rows = trained.run.log_rows(trained.step)
    training = trained.cost
    if training is None:  # of a version that measured seconds alone
        device, seconds = str(trained.provenance.get("device")), rows[-1]["seconds"] if rows else None
        training = TrainingCost(device=device, seconds=seconds)
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
    """How a run differs from one that goes through as configured, with this version; empty where it does not."""
    lengths = ("steps", "written_for")
    jumps = [
        change
        for change in provenance.get("schedule_changes", [])
        if any(change["from"][name] != change["to"][name] for name in lengths)
    ]
    version = provenance.get("package_version", __version__)
    return {
        **({} if step == configured else {"step": step}),
        **({"schedule_changes": jumps} if jumps else {}),
        **({} if version == __version__ else {"trained_with": version}),
    }
