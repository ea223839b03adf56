"""What a file of Gaussians loses of the run that it was made of, on the held-out views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from coliags_plugin.contracts import Comparison
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.held_light import render_held
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.export.baking.explicit import field_of_cloud
from coliags_plugin.export.splats.cloud import SplatCloud
from coliags_plugin.lighting.lamps import HeldLight
from coliags_plugin.renderers.choice import choose_renderer

#: Metrics of protocols that are compared.
_METRICS = ("psnr", "depth_mse")


def export_cost(trained: TrainedRun, cloud: SplatCloud, light: HeldLight | None) -> dict[str, dict[str, Any]]:
    """Compare a cloud with its run on every held-out view, by the run's protocol; means per test set.

    Where a lamp moves with the camera, no cloud can show recorded frames: it is compared under the held light, with the
    frames brought to that light: the run's own render there, plus what the run's render misses of the frame. By that
    the run's PSNR is that of its evaluation, and the cloud's differs by baking alone.

    Returns:
        By test set: ``frames`` (their number), ``run`` and ``export`` (means by metric), ``cost`` (dB that PSNR falls,
        mm^2 that the squared error of depth rises), ``psnr_between`` (of the cloud against the run under that light)
        and ``psnr_recorded`` (of the cloud against the frames as recorded).
    """
    scorer = Scorer(trained.config.protocol, _METRICS)
    renderer = choose_renderer(trained.config.renderer, "gaussians3d", trained.device).renderer
    baked = Model(field_of_cloud(cloud).to(trained.device), renderer, {}, trained.model.near_plane).eval()
    sets = {name: frames for name, frames in trained.scene.test_sets.items() if frames}
    total, done, costs = sum(map(len, sets.values())), 0, dict[str, dict[str, Any]]()
    with ProgressReport("compare with the run", total) as progress:
        for name, frames in sets.items():
            rows = []
            for frame in frames:
                rows.append(_scores(trained, scorer, baked, frame.to(trained.device), light))
                done += 1
                progress.update(done)
            costs[name] = _summary(rows)
    return costs


@torch.no_grad()
def _scores(
    trained: TrainedRun, scorer: Scorer, baked: Model, frame: Frame, light: HeldLight | None
) -> dict[str, dict[str, float]]:
    """Values by metric, of ``run``, ``export``, ``between`` and ``recorded``."""
    run = scorer.protocol.compare(scorer.render(trained.model, frame), frame)
    export = scorer.protocol.compare(scorer.render(baked, frame), frame)
    held = run
    if light is not None:
        held = scorer.protocol.compare(render_held(trained.model, frame.camera, light, scorer.wants), frame)
    at_light = held.rgb + (run.true_rgb - run.rgb)

    def values(comparison: Comparison, true_rgb: torch.Tensor) -> dict[str, float]:
        return scorer.score(replace(comparison, true_rgb=true_rgb)).values

    return {
        "run": values(run, run.true_rgb),
        "export": values(export, at_light),
        "between": values(export, held.rgb),
        "recorded": values(export, run.true_rgb),
    }


def _summary(rows: list[dict[str, dict[str, float]]]) -> dict[str, Any]:
    run, export = _means(rows, "run"), _means(rows, "export")
    signs = {"psnr": -1.0, "depth_mse": 1.0}
    return {
        "frames": len(rows),
        "run": run,
        "export": export,
        "cost": {
            name: sign * (export[name] - run[name]) for name, sign in signs.items() if name in run and name in export
        },
        "psnr_between": _means(rows, "between").get("psnr"),
        "psnr_recorded": _means(rows, "recorded").get("psnr"),
    }


def _means(rows: list[dict[str, dict[str, float]]], part: str) -> Mapping[str, float]:
    """Means of the metrics that some frame has, over the frames that have them."""
    values_by_name = {name: [row[part][name] for row in rows if name in row[part]] for name in _METRICS}
    return {name: sum(values) / len(values) for name, values in values_by_name.items() if values}
