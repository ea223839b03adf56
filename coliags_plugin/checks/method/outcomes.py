"""Checks of what users do with a run: evaluation and images."""

from __future__ import annotations

import json
import math
from dataclasses import replace

from coliags_plugin.checks.method.bench import Bench
from coliags_plugin.checks.method.results import CheckFailedError, CheckSkippedError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.rendering import render_run
from coliags_plugin.engine.trained import TrainedRun

#: Frames of each test set that are rendered.
_FRAMES = 2


def evaluates(bench: Bench) -> str:
    """The method's protocol yields finite metrics, or reasons for those that cannot be had."""
    trained = _few_frames(bench)
    file = evaluate(trained, trained.config.protocol) / "metrics.json"
    summary = json.loads(file.read_text(encoding="utf-8"))
    names = [name for name in summary["directions"] if name in summary]
    unexplained = [
        name
        for name in names
        if not (summary["reasons"].get(name) if summary[name] is None else math.isfinite(summary[name]))
    ]
    if unexplained:
        raise CheckFailedError(f"metrics without value or reason: {', '.join(unexplained)}")
    values = [f"{name} {summary[name]:.4g}" for name in names if summary[name] is not None]
    if not values:
        raise CheckFailedError(f"no metric has a value: {next(iter(summary['reasons'].values()))}")
    return f"{trained.config.protocol}: {', '.join(values[:4])}"


def writes_images(bench: Bench) -> str:
    """``coliags render`` writes an image of every kind for every frame."""
    trained = _few_frames(bench)
    name, frames = next(iter(trained.scene.test_sets.items()))
    folder = bench.folder / "renders"
    render_run(trained, folder, name, video=False, fps=15.0, overwrite=True)
    kinds = {"rgb", "depth", "rgb_error"} | ({"depth_error"} if frames[0].depth is not None else set())
    wanted = [folder / kind / f"{frame.name}.png" for kind in sorted(kinds) for frame in frames]
    missing = [path for path in wanted if not path.is_file() or not path.stat().st_size]
    if missing:
        raise CheckFailedError(f"no image {missing[0].relative_to(folder)}")
    return f"{len(wanted)} images"


def _few_frames(bench: Bench) -> TrainedRun:
    """The run with only a few test frames."""
    scene: Scene = bench.trained.scene
    sets = {name: frames[:_FRAMES] for name, frames in scene.test_sets.items() if frames}
    if not sets:
        raise CheckSkippedError("the scene holds out no test frames")
    return replace(bench.trained, scene=replace(scene, test_sets=sets))
