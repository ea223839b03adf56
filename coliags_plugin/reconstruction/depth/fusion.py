"""Fusion of the depth maps of neighbouring frames, and the probability that fused depth is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from coliags_plugin.reconstruction.depth.sweeping import Swept
from coliags_plugin.reconstruction.depth.views import Pose

#: Iterations until a ray has met a neighbour's surface, and the relative change at which it has.
_ITERATIONS, _CONVERGED = 12, 1e-3


@dataclass(frozen=True, eq=False)
class WeightedDepth:
    """Depth of a frame with weights.

    Attributes:
        pose: Camera of its size.
        depth: z-depth; NaN where unknown. [H, W]
        weight: 0 where it does not count. [H, W]
    """

    pose: Pose
    depth: Float32[np.ndarray, "H W"]
    weight: Float32[np.ndarray, "H W"]


@dataclass(frozen=True, eq=False)
class Fused:
    """Depth that a frame and its neighbours agree on.

    Attributes:
        depth: z-depth; the frame's own where no other counts. [H, W]
        votes: Weight of the frames that agree with it. [H, W]
        against: Weight of those that do not. [H, W]
        spread: Mean relative deviation within the group. [H, W]
    """

    depth: Float32[np.ndarray, "H W"]
    votes: Float32[np.ndarray, "H W"]
    against: Float32[np.ndarray, "H W"]
    spread: Float32[np.ndarray, "H W"]


def fuse_frame(own: WeightedDepth, neighbours: Sequence[WeightedDepth], agreement: float) -> Fused:
    """Weighted median of the depths that a frame and its neighbours give to each pixel, within the densest group.

    A neighbour's depth of a pixel is where the pixel's ray meets the neighbour's surface, found by fixed-point
    iteration from the frame's own depth.

    Args:
        own: The frame.
        neighbours: Others that may see the same surface.
        agreement: Relative difference up to which two depths agree.
    """
    from coliags_plugin.reconstruction.depth.numba_kernels.fusion import reproject, vote

    shape = own.depth.shape
    candidates = np.empty((len(neighbours), *shape), np.float32)
    trusts = np.empty_like(candidates)
    for index, other in enumerate(neighbours):
        turn, shift = own.pose.homography(other.pose)
        back, origin = own.pose.depth_from(other.pose)
        reproject(
            own.depth,
            other.depth,
            other.weight,
            turn,
            shift,
            back,
            origin,
            _ITERATIONS,
            np.float32(_CONVERGED),
            candidates[index],
            trusts[index],
        )
    fused, votes, against, spread = (np.empty(shape, np.float32) for _ in range(4))
    vote(own.depth, own.weight, candidates, trusts, np.float32(agreement), fused, votes, against, spread)
    return Fused(fused, votes, against, spread)


#: Of the regression: constant, log support, log spread, near side of an edge, log depth across a window.
_COEFFICIENTS = (1.125, 0.797, -0.187, -1.396, -2.229)
#: Half the width of that window, pixels.
_STEP_REACH = 6


def sweep_weight(swept: Swept) -> Float32[np.ndarray, "H W"]:
    """Weight of a frame's own depth in fusion, 0 to 1. [H, W]"""
    quality = np.clip((swept.match - 0.2) / 0.6, 0.0, 1.0) * np.clip(swept.margin / 1.0, 0.0, 1.0)
    return np.asarray(np.where(swept.match > 0.0, 0.05 + 0.95 * quality, 0.0), np.float32)


def depth_confidence(
    log_depth: Float32[np.ndarray, "H W"],
    support: Float32[np.ndarray, "H W"],
    spread: Float32[np.ndarray, "H W"],
    rim: Bool[np.ndarray, "H W"],
) -> Float32[np.ndarray, "H W"]:
    """Estimated probability that depth is off by less than 5 %: a logistic regression (docs/depth.md).

    Args:
        log_depth: Log of the completed z-depth. [H, W]
        support: Number of frames that agree with it, weighted; 0 where a prior alone speaks. [H, W]
        spread: Mean relative deviation of their depths. [H, W]
        rim: Near side of a depth edge. [H, W]

    Returns:
        0 to 1; 0 where there is no support. [H, W]
    """
    import cv2

    window = np.ones((2 * _STEP_REACH + 1, 2 * _STEP_REACH + 1), np.uint8)
    step = np.minimum(cv2.dilate(log_depth, window) - cv2.erode(log_depth, window), 1.0)
    constant, of_support, of_spread, of_rim, of_step = _COEFFICIENTS
    score = constant + of_support * np.log(support + 0.1) + of_spread * np.log(spread + 0.003)
    score += of_rim * rim + of_step * step
    return np.where(support > 0.0, 1.0 / (1.0 + np.exp(-score)), 0.0).astype(np.float32)
