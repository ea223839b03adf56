"""The verdict on the geometry of a sub-map, usable, doubtful or not usable, with its reasons and what it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from coliags_plugin.comparison.report.views import evenly
from coliags_plugin.core.depth_maps import Pose, WeightedDepth, depths_by
from coliags_plugin.engine.rendering import opaque_depth, render_view
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.geometry.meshes.mesh import TriangleMesh

#: Verdicts, the best first.
VERDICTS = ("usable", "doubtful", "not usable")
#: Views that are compared, each with so many on either side, and the relative difference of contradicting depths.
_VIEWS, _REACH, _DISAGREES = 12, 3, 0.05


@dataclass(frozen=True)
class Limit:
    """Values of a figure from which on a sub-map is doubtful, or not usable, and the reason in words."""

    doubtful: float
    not_usable: float  # below the other where small values are the bad ones
    reason: str

    def verdict(self, value: float) -> str:
        """The verdict by this figure alone."""
        sign = 1.0 if self.not_usable > self.doubtful else -1.0
        return VERDICTS[sum(sign * value >= sign * limit for limit in (self.doubtful, self.not_usable))]


LIMITS = {
    "frames": Limit(10, 5, "only {:.0f} frames"),
    "gap": Limit(4.0, 8.0, "held-out views are {:.1f} dB worse than training views"),
    "pose_gain": Limit(1.5, 4.0, "held-out views gain {:.1f} dB once their poses are refined"),
    "confident": Limit(0.30, 0.10, "{:.0%} of the pixels have confident depth"),
    "contradicted": Limit(0.06, 0.30, "{:.0%} of the pixels have a depth that neighbouring views contradict"),
    "covered": Limit(0.60, 0.30, "the mesh covers {:.0%} of what views show"),
    "largest_part": Limit(0.75, 0.30, "the largest piece of the mesh has {:.0%} of its area"),
}


def judge(figures: Mapping[str, Any]) -> tuple[str, list[str]]:
    """The worst of the verdicts by each figure, and reasons, the worst first; a figure that is missing has none."""
    found = [(LIMITS[name].verdict(figures[name]), name) for name in LIMITS if name in figures]
    worst_first = sorted(found, key=lambda each: -VERDICTS.index(each[0]))
    reasons = [
        LIMITS[name].reason.format(figures[name]).replace("%", " %")
        for verdict, name in worst_first
        if verdict != VERDICTS[0]
    ]
    return worst_first[0][0] if worst_first else VERDICTS[0], reasons


def measured_geometry(trained: TrainedRun, mesh: TriangleMesh) -> dict[str, float]:
    """Figures of a run's geometry, by the names of :data:`LIMITS`, and ``parts``, the number of pieces of its mesh.

    Pieces are connected by vertices. Views are evenly spread training views: ``covered`` is the share of their rays
    that meet the mesh, ``contradicted`` the share of their pixels, in the mean over up to three views on either side,
    at which those see a surface whose expected depth differs by 5 % or more.
    """
    areas = np.bincount(mesh.parts, mesh.areas)
    areas = areas[areas > 0.0]
    frames, views, covered = trained.scene.train, list[WeightedDepth](), list[float]()
    for index in evenly(len(frames), _VIEWS):
        frame = frames[index]
        output = render_view(trained, frame, ("alpha", "depth_accumulated"))
        camera, valid = output.camera or frame.camera, frame.valid.cpu()
        expected = (opaque_depth(output, "depth_accumulated") / output.alpha).cpu()
        depth = torch.where(valid, expected, torch.nan).numpy()
        views.append(WeightedDepth(Pose.of(camera), depth, np.ones_like(depth)))
        camera = camera.to("cpu", torch.float64)
        triangle, _ = mesh.rays.cast(camera.center.numpy(), camera.rays()[valid].numpy())
        covered.append(float((triangle >= 0).mean()))
    contradicted = list[float]()
    for place, view in enumerate(views):
        others, size = [*views[max(0, place - _REACH) : place], *views[place + 1 : place + 1 + _REACH]], view.depth.size
        depth, by_others, _ = depths_by(others, view)
        differs = np.abs(by_others[:, :size] / depth[:size] - 1.0) >= _DISAGREES
        contradicted.append(float(differs.sum() / max(1, len(others)) / max(1, np.isfinite(depth[:size]).sum())))
    return {
        "parts": len(areas),
        "largest_part": float(areas.max() / areas.sum()),
        "covered": float(np.mean(covered)),
        "contradicted": float(np.mean(contradicted)),
    }
