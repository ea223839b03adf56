"""Evaluation of a run's held-out views under one protocol, and the result that is composed of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_write, write_json
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine.checkpoints import checkpoint_folder
from coliags_plugin.engine.costs import RenderMeter, TrainingCost, seconds_to_psnr
from coliags_plugin.engine.devices import device_name, software
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.scoring import EvaluatedSet, Scorer
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.reporting.colormaps import (
    color_bar,
    colorize_depth,
    colorize_error,
    depth_error,
    depth_limits,
    error_limit,
)
from coliags_plugin.reporting.image_files import eight_bit, read_depth_tiff, write_depth_tiff, write_png
from coliags_plugin.results.hashing import code_key, metrics_sha256, plain_config, result_key
from coliags_plugin.results.reading import RESULT_FILE, per_frame_table, write_result
from coliags_plugin.results.record import (
    REFINED_SUFFIXES,
    CostRecord,
    MetricRecord,
    ProtocolRecord,
    Result,
    SceneRecord,
)

#: Keys of the provenance of a run and of its scene that a result has in another place.
_LEFT_OUT = ("method", "seed", "steps", "scene", "untrained_views", "fingerprint", "held_out_used")
#: Folder of an evaluation's expected depth, NaN where pixels are nearly transparent.
EXPECTED_DEPTH = "expected_depth"


def evaluate(trained: TrainedRun, protocol_name: str, other: Scene | None = None, refine_poses: bool = False) -> Result:
    """Render every held-out view, and write the protocol's metrics and the images.

    Writes into ``eval/<protocol>/``: ``result.json``, the whole :class:`~coliags_plugin.results.record.Result`; and
    of it ``metrics.json`` (means per test set; the main set's also at the top; null where a metric is not available,
    with the reason) and ``per_frame.csv``; and the images. An earlier evaluation under the same protocol is replaced
    once the new one is complete. Frames of another scene with the true depth take the place of the run's own
    (:func:`match_truth`); the folder is then ``eval/<protocol>-truth/``. With ``refine_poses`` there are also metrics
    of views from poses refined on the held-out images themselves, under names of their own
    (:func:`~coliags_plugin.engine.scoring.refined_camera`).
    """
    if trained.relit:
        raise InputError(
            "evaluation of a relit run", "the lamp that the data were recorded with", "Evaluate the run as loaded"
        )
    scorer = Scorer(protocol_name)
    truth = None if other is None else match_truth(trained.scene, other)
    scene = trained.scene if truth is None else truth.scene
    check_evaluable(trained.model, scene, scorer)
    sets = {name: frames for name, frames in scene.test_sets.items() if frames}
    total, count = sum(map(len, sets.values())), 0
    target = trained.run.evaluation(scorer.protocol.name, against_truth=truth is not None)
    scale = 1.0 if scene.is_metric else trained.model.scale
    evaluated = {name: EvaluatedSet(scene.length_unit, scorer, scale) for name in sets}
    meter = RenderMeter(trained.device)
    with atomic_folder(target, overwrite=True) as scratch, ProgressReport("evaluate", total) as progress:
        for set_name, frames in sets.items():
            for frame in frames:
                placed = frame.to(trained.device)
                output = meter.render(partial(scorer.render, trained.model, placed))
                comparison = scorer.protocol.compare(output, placed)
                refined = scorer.refined(trained.model, placed) if refine_poses else ()
                evaluated[set_name].add(placed, comparison, output.alpha, *refined)
                _write_images(scratch, set_name, frame, comparison)
                if (depth := output.expected_depth) is not None:
                    write_depth_tiff(scratch / EXPECTED_DEPTH / set_name / f"{frame.name}.tiff", depth)
                count += 1
                progress.update(count)
            _write_error_pictures(scratch, set_name, scene.length_unit)
        _write_depth_pictures(scratch, scene.length_unit)
        result = _result(trained, scorer, evaluated, meter, truth)
        write_result(scratch / RESULT_FILE, result)
        write_json(scratch / "metrics.json", result.summary())
        atomic_write(scratch / "per_frame.csv", per_frame_table(result))
    return result


def check_evaluable(model: Model, scene: Scene, scorer: Scorer) -> None:
    """Refuse a renderer without the protocol's outputs, and a scene without test frames."""
    model.check_outputs(scorer.wants, f"protocol '{scorer.protocol.name}'")
    if not any(scene.test_sets.values()):
        raise InputError(f"scene '{scene.name}' has no test frames", "a split that holds some out")


def _write_images(folder: Path, set_name: str, frame: Frame, comparison: Comparison) -> None:
    name = f"{set_name}/{frame.name}"
    write_png(folder / "renders" / f"{name}.png", eight_bit(comparison.rgb))
    write_png(folder / "truth" / f"{name}.png", frame.image)
    if comparison.depth is None or comparison.true_depth is None or comparison.depth_valid is None:
        return
    true_depth = torch.where(comparison.depth_valid, comparison.true_depth, torch.nan)
    write_depth_tiff(folder / "depth" / f"{name}.tiff", comparison.depth)
    write_depth_tiff(folder / "true_depth" / f"{name}.tiff", true_depth)


def _write_error_pictures(evaluation: Path, set_name: str, unit: str) -> None:
    """Colour the errors of the depth maps of ``depth/SET/`` as ``errors/SET/``, beside their scale."""

    def error(file: Path) -> np.ndarray:
        return depth_error(read_depth_tiff(file), read_depth_tiff(evaluation / "true_depth" / set_name / file.name))

    if files := sorted((evaluation / "depth" / set_name).glob("*.tiff")):
        end = error_limit(map(error, files))
        for file in files:
            write_png(evaluation / "errors" / set_name / f"{file.stem}.png", colorize_error(error(file), end))
        write_png(evaluation / "errors" / f"{set_name}_scale.png", color_bar((0.0, end), unit, "error"))


def _write_depth_pictures(evaluation: Path, unit: str) -> None:
    """Colour the depth maps of ``expected_depth/SET/`` as ``depth_pictures/SET/``, beside their scale."""
    files = sorted((evaluation / EXPECTED_DEPTH).glob("*/*.tiff"))
    if not files:
        return
    limits = depth_limits(read_depth_tiff(file) for file in files)
    for file in files:
        picture = evaluation / "depth_pictures" / file.parent.name / f"{file.stem}.png"
        write_png(picture, colorize_depth(read_depth_tiff(file), limits, hatched=True))
    write_png(evaluation / "depth_pictures" / "scale.png", color_bar(limits, unit, "depth"))


def _result(
    trained: TrainedRun,
    scorer: Scorer,
    evaluated: Mapping[str, EvaluatedSet],
    meter: RenderMeter,
    truth: Truth | None,
) -> Result:
    """Compose the result of a run from its test sets, at least one, and what rendering them cost.

    ``truth`` is what it was evaluated against, if not its own scene.
    """
    protocol, provenance = scorer.protocol, trained.provenance
    config = plain_config(trained.config.model_dump())
    data = trained.scene if truth is None else truth.scene
    camera = next(frame for frames in data.test_sets.values() for frame in frames).camera
    sets = {name: part.record() for name, part in evaluated.items()}
    scored = {name for part in evaluated.values() for name in part.scored}
    metrics = scorer.metrics | {name: each for name, each in scorer.further_metrics.items() if name in scored}
    deviations = _deviations(trained.step, config["schedule"]["steps"], provenance)
    if truth is not None:
        deviations["truth"] = data.provenance.fingerprint
    if any(name.endswith(REFINED_SUFFIXES) for name in scored):
        deviations["refined"] = list(REFINED_SUFFIXES)
    return Result(
        key=result_key(
            config,
            trained.scene.provenance.fingerprint,
            trained.seed,
            code_key(),
            protocol.name,
            protocol.version,
            deviations,
        ),
        method=trained.method,
        scene=SceneRecord(
            name=data.name,
            fingerprint=data.provenance.fingerprint,
            split=data.provenance.split_name,
            train=tuple(frame.name for frame in data.train),
            size=(camera.width, camera.height),
        ),
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
            "scene": {name: value for name, value in data.provenance.record().items() if name not in _LEFT_OUT},
            **({"held_out_used": used} if (used := trained.scene.provenance.held_out_used) else {}),
            **({"learned": learned} if (learned := trained.model.learned) else {}),
            **({} if truth is None else {"truth": _described(truth, trained.scene)}),
        },
    )


def _described(truth: Truth, original: Scene) -> JsonObject:
    trained_on = {
        "name": original.name,
        **original.provenance.model_dump(include={"dataset", "unit", "fingerprint"}),
    }
    return {"scene": truth.scene.name, "matched_by": truth.matched_by, "trained_on": trained_on}


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
    """Differences of a run from one that goes through as configured, with this code; empty if there are none."""
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


#: Largest distance between the cameras of a frame in the two scenes, as a share of the scene's extent.
_SAME_PLACE = 0.01


@dataclass(frozen=True)
class Truth:
    """Scene with true depth, for the evaluation of a run that was trained on another scene of the same video.

    Attributes:
        scene: The scene with the true depth: its test sets are what is evaluated, its training frames those that the
            run was trained on, as this scene calls them.
        matched_by: How frames of the two scenes were found to be the same.
    """

    scene: Scene
    matched_by: Literal["name", "index"]


def match_truth(scene: Scene, other: Scene) -> Truth:
    """Find the frames of a run's scene in another one, which has the true depth.

    The set ``test`` is that of the first scene, further sets are those of the second. Frames are matched by name if
    all names are there, else by their index in the video if the scenes have equally many frames.
    """
    mine, theirs = scene.video, other.video
    by_name = {frame.name: frame for frame in theirs}
    by_index = {frame.index: frame for frame in theirs}
    matched_by: Literal["name", "index"] = "name"
    if all(frame.name in by_name for frame in mine):
        matches = {frame.name: by_name[frame.name] for frame in mine}
    elif len(mine) == len(theirs) and all(frame.index in by_index for frame in mine):
        matches, matched_by = {frame.name: by_index[frame.index] for frame in mine}, "index"
    else:
        lone = next(frame.name for frame in mine if frame.name not in by_name)
        raise InputError(
            f"scene '{other.name}' has no frame '{lone}', and {len(theirs)} frames for the {len(mine)} of scene "
            f"'{scene.name}'",
            "the same video, with frames of the same names or in the same number",
            "Name the scene that this one was made from",
        )
    _refuse_other_world(mine, matches, scene.extent, other.name)
    train = [matches[frame.name] for frame in scene.train]
    same_split = {frame.name for frame in train} == {frame.name for frame in other.train}
    sets = {"test": [matches[frame.name] for frame in scene.test_sets.get("test", [])]}
    sets |= {name: frames for name, frames in other.test_sets.items() if name != "test"}
    if not same_split:  # seen masks tell what the other scene's training frames show
        sets = {name: [frame.with_maps(seen=None) for frame in frames] for name, frames in sets.items()}
    split = (other if same_split else scene).provenance.split
    provenance = other.provenance.model_copy(update={"split": split})
    held_out = {name: frames for name, frames in sets.items() if frames}
    return Truth(replace(other, train=train, test_sets=held_out, provenance=provenance), matched_by)


def _refuse_other_world(frames: Sequence[Frame], matches: dict[str, Frame], extent: float, name: str) -> None:
    for frame in frames:
        apart = float((frame.camera.center.double() - matches[frame.name].camera.center.double()).norm())
        if not apart <= _SAME_PLACE * extent:
            raise InputError(
                f"frame '{frame.name}' was taken {apart:.3g} units away from its place in scene '{name}'",
                "scenes with the same poses, in the same unit",
                "Align the scenes first, or evaluate against the scene that the poses are from",
            )
