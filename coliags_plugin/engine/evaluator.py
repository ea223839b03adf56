"""Evaluation of a run's held-out views under one protocol."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_folder, atomic_write, write_json
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine.costs import RenderMeter
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.pose_refinement import refined_scores
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.run_result import EvaluatedSet, run_result
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.truth import match_truth
from coliags_plugin.outputs.colormaps import (
    DEPTH_ERROR_LIMIT_MM,
    color_bar,
    colorize_depth,
    colorize_depth_error,
    common_limits,
)
from coliags_plugin.outputs.image_files import eight_bit, read_depth_tiff, write_depth_tiff, write_png
from coliags_plugin.results.reading import RESULT_FILE, write_result
from coliags_plugin.results.summaries import means_summary
from coliags_plugin.results.tables import per_frame_table

logger = logging.getLogger(__name__)

#: Folder of an evaluation's expected depth, NaN where pixels are nearly transparent.
EXPECTED_DEPTH = "expected_depth"


def evaluate(trained: TrainedRun, protocol_name: str, other: Scene | None = None, refine_poses: bool = False) -> Path:
    """Render every held-out view, write the protocol's metrics and the images, and return their folder.

    Writes into ``eval/<protocol>/``: ``result.json``, the whole :class:`~coliags_plugin.results.record.Result`; and
    of it ``metrics.json`` (means per test set; the main set's also at the top; null where a metric is not available,
    with the reason) and ``per_frame.csv``; and the images. An earlier evaluation under the same protocol is replaced
    once the new one is complete. Frames of another scene with the true depth take the place of the run's own
    (:mod:`coliags_plugin.engine.truth`); the folder is then ``eval/<protocol>-truth/``. With ``refine_poses`` there are
    also metrics of views from poses refined on the held-out images themselves, under names of their own
    (:mod:`coliags_plugin.engine.pose_refinement`).
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
    total, done = sum(map(len, sets.values())), 0
    target = trained.run.evaluation(scorer.protocol.name, against_truth=truth is not None)
    evaluated = {name: EvaluatedSet(scene.length_unit, scorer) for name in sets}
    meter = RenderMeter(trained.device)
    with atomic_folder(target, overwrite=True) as scratch, ProgressReport("evaluate", total) as progress:
        for set_name, frames in sets.items():
            for frame in frames:
                placed = frame.to(trained.device)
                output = meter.render(partial(scorer.render, trained.model, placed))
                comparison = scorer.protocol.compare(output, placed)
                evaluated[set_name].add(placed, comparison, output.alpha)
                if refine_poses:
                    for suffix, scores in refined_scores(trained.model, placed, scorer).items():
                        evaluated[set_name].add_scores(frame.name, scores, suffix)
                _write_images(scratch, set_name, frame, comparison)
                if (depth := output.expected_depth) is not None:
                    write_depth_tiff(scratch / EXPECTED_DEPTH / set_name / f"{frame.name}.tiff", depth)
                done += 1
                progress.update(done)
        _write_depth_pictures(scratch, scene.length_unit)
        result = run_result(trained, scorer, evaluated, meter, truth)
        _warn_of_bounds(trained.model.learned)
        write_result(scratch / RESULT_FILE, result)
        write_json(scratch / "metrics.json", means_summary(result))
        atomic_write(scratch / "per_frame.csv", per_frame_table(result))
    return target


def _warn_of_bounds(learned: Mapping[str, Any]) -> None:
    """Warn of frames whose learned numbers, such as gains, are at their bounds."""
    for name, numbers in learned.items():
        frames = numbers.get("at_bound", ())
        if frames:
            shown = ", ".join(frames[:6]) + (", ..." if len(frames) > 6 else "")
            logger.warning("module '%s' is at a bound in %d frames: %s", name, len(frames), shown)


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
    known = torch.where(comparison.depth_valid, comparison.true_depth, torch.nan)
    write_depth_tiff(folder / "depth" / f"{name}.tiff", comparison.depth)
    write_depth_tiff(folder / "true_depth" / f"{name}.tiff", known)
    errors = colorize_depth_error(comparison.depth, known, comparison.depth_valid, DEPTH_ERROR_LIMIT_MM)
    write_png(folder / "errors" / f"{name}.png", errors)


def _write_depth_pictures(evaluation: Path, unit: str) -> None:
    """Colour the depth maps of ``expected_depth/SET/`` as ``depth_pictures/SET/``, beside their scale."""
    files = sorted((evaluation / EXPECTED_DEPTH).glob("*/*.tiff"))
    if not files:
        return
    limits = common_limits(read_depth_tiff(file) for file in files)
    for file in files:
        picture = evaluation / "depth_pictures" / file.parent.name / f"{file.stem}.png"
        write_png(picture, colorize_depth(read_depth_tiff(file), limits, hatched=True))
    write_png(evaluation / "depth_pictures" / "scale.png", color_bar(limits, unit, "depth"))
