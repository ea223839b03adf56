"""Comparison of estimated with true depth, frame by frame and over all pixels."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from coliags_plugin.checks.depth import pairing
from coliags_plugin.checks.depth.measures import DepthErrors, DepthStatistics, measure, median_scale, pooled
from coliags_plugin.checks.depth.pairing import FramePairs, Samples
from coliags_plugin.checks.depth.sources import DepthSource
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.progress import Progress, with_progress


@dataclass(frozen=True)
class FrameErrors:
    """Errors of one frame's estimate; None where the truth has no depth of that kind."""

    name: str  # of the estimate's frame
    dense: DepthErrors | None  # against dense depth and against single points
    sparse: DepthErrors | None


@dataclass(frozen=True)
class DepthCheck:
    """Result of the comparison."""

    estimate: DepthSource  # what was compared
    truth: DepthSource
    pairs: FramePairs  # the frames in both
    unit: str  # of lengths: ``"mm"``, or ``"units of the truth"``
    scale: float | None  # factor that the estimate was multiplied by; None: not aligned
    #: statistics over all pixels and points of all frames; None where the truth has no such depth
    dense: DepthStatistics | None
    sparse: DepthStatistics | None
    frames: list[FrameErrors]

    def as_json(self) -> dict[str, Any]:
        """The same as JSON values; unavailable ones are null."""
        return {
            "estimate": self.estimate.path.resolve().name,
            "truth": self.truth.path.resolve().name,
            "unit": self.unit,
            "aligned_by_factor": self.scale,
            "frames_matched_by": self.pairs.by,
            "frames_left_out": dict(zip(("estimate", "truth"), self.pairs.left_out, strict=True)),
            "dense": None if self.dense is None else asdict(self.dense),
            "sparse": None if self.sparse is None else asdict(self.sparse),
            "frames": [asdict(frame) for frame in self.frames],
        }


def check_depth(
    estimate: DepthSource, truth: DepthSource, align_scale: bool = False, progress: Progress | None = None
) -> DepthCheck:
    """Compare estimated with true depth, which is dense, at single points, or both.

    ``align_scale`` multiplies the estimate by the median of true / estimated depth over all pixels.
    """
    unknown = [str(source.path) for source in (estimate, truth) if not source.metric]
    if unknown and not align_scale:
        raise InputError(
            f"the unit of length of {' and of '.join(unknown)} is unknown",
            "lengths in mm",
            "Pass --align-scale to compare up to one factor, the median of true / estimated depth",
        )
    pairs = pairing.match_frames(estimate, truth)
    dense: list[Samples | None] = []
    sparse: list[Samples | None] = []
    for here, there in with_progress(pairs.indices, "compare depth", progress):
        estimated, true = estimate.read(here), truth.read(there)
        if true.confidence is not None:
            raise InputError(
                f"{truth.path} holds estimated depth: frame {truth.names[there]} has a confidence",
                "true depth",
                "Name the estimate first and the truth second",
            )
        pairing.check_same_view(estimate.names[here], estimated, true)
        surface = pairing.true_depth_at(estimated, true)
        dense.append(None if surface is None else pairing.dense_samples(estimated, surface))
        sparse.append(pairing.sparse_samples(estimated, true))
    of_all = [pooled(dense), pooled(sparse)]
    counted = [samples for samples in of_all if samples is not None and np.isfinite(samples.estimated).any()]
    if not counted:
        raise InputError(
            f"{estimate.path} has no estimate at any of the {sum(len(s.true) for s in of_all if s is not None)} pixels "
            f"of {len(pairs.indices)} frames whose depth {truth.path} knows",
            "an estimate and a truth that overlap",
            "Check that both have depth, and which of the two paths is the estimate",
        )
    scale = median_scale(counted[0]) if align_scale else None
    factor = 1.0 if scale is None else scale
    measured = [None if samples is None else measure(samples, factor) for samples in of_all]
    frames = [
        FrameErrors(estimate.names[here], _frame_errors(surface, factor), _frame_errors(points, factor))
        for (here, _), surface, points in zip(pairs.indices, dense, sparse, strict=True)
    ]
    unit = "mm" if truth.metric else "units of the truth"
    return DepthCheck(estimate, truth, pairs, unit, scale, measured[0], measured[1], frames)


def _frame_errors(samples: Samples | None, scale: float) -> DepthErrors | None:
    return None if samples is None else measure(samples, scale).errors
