"""Fusion of the depth maps of neighbouring frames, and the probability that fused depth is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coliags_plugin.reconstruction.depth.sweeping import Swept
from coliags_plugin.reconstruction.depth.views import Map, Mask, Pose

#: Iterations until a ray has met a neighbour's surface, and the relative change at which it has.
_ITERATIONS, _CONVERGED = 12, 1e-3


@dataclass(frozen=True, eq=False)
class WeightedDepth:
    """Depth of a frame with weights."""

    pose: Pose  # camera of its size
    depth: Map  # z-depth; NaN where unknown
    weight: Map  # 0 where it does not count


@dataclass(frozen=True, eq=False)
class Fused:
    """Depth that a frame and its neighbours agree on."""

    depth: Map  # z-depth; the frame's own where no other counts
    votes: Map  # weight of the frames that agree with it
    against: Map  # weight of those that do not
    spread: Map  # mean relative deviation within the group


def fuse_frame(own: WeightedDepth, neighbours: Sequence[WeightedDepth], agreement: float) -> Fused:
    """Weighted median of the depths that a frame and its neighbours give to each pixel, within the densest group.

    A neighbour's depth of a pixel is where the pixel's ray meets the neighbour's surface, found by fixed-point
    iteration from the frame's own depth. Depths agree up to a relative difference of ``agreement``.
    """
    from coliags_plugin.core.numba_kernels.lanes import WIDTH
    from coliags_plugin.reconstruction.depth.numba_kernels.fusion import reproject, vote

    height, width = own.depth.shape
    size = height * width
    rest = (0, -size % WIDTH)
    depth, weight = np.pad(own.depth.ravel(), rest), np.pad(own.weight.ravel(), rest)
    candidates = np.empty((len(neighbours), len(depth)), np.float32)
    trusts = np.empty_like(candidates)
    for index, other in enumerate(neighbours):
        turn, shift = own.pose.homography(other.pose)
        back, origin = own.pose.depth_from(other.pose)
        reproject(
            depth,
            width,
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
    written = np.empty((4, len(depth)), np.float32)
    vote(depth, weight, candidates, trusts, np.float32(agreement), *written)
    return Fused(*written[:, :size].reshape(4, height, width))


#: Of the regression: constant, log support, log spread, near side of an edge, log depth across a window.
_COEFFICIENTS = (1.125, 0.797, -0.187, -1.396, -2.229)
#: Half the width of that window, pixels.
_STEP_REACH = 6


def sweep_weight(swept: Swept) -> Map:
    """Weight of a frame's own depth in fusion, 0 to 1."""
    quality = np.clip((swept.match - 0.2) / 0.6, 0.0, 1.0) * np.clip(swept.margin / 1.0, 0.0, 1.0)
    return np.asarray(np.where(swept.match > 0.0, 0.05 + 0.95 * quality, 0.0), np.float32)


def depth_confidence(log_depth: Map, support: Map, spread: Map, rim: Mask) -> Map:
    """Estimated probability that depth is off by less than 5 %: a logistic regression (docs/depth.md).

    ``support`` is the weighted number of frames that agree with the completed depth, 0 (as is the confidence) where a
    prior alone speaks; ``spread`` the mean relative deviation of their depths; ``rim`` the near side of a depth edge.
    """
    import cv2

    window = np.ones((2 * _STEP_REACH + 1, 2 * _STEP_REACH + 1), np.uint8)
    step = np.minimum(cv2.dilate(log_depth, window) - cv2.erode(log_depth, window), 1.0)
    constant, of_support, of_spread, of_rim, of_step = _COEFFICIENTS
    score = constant + of_support * np.log(support + 0.1) + of_spread * np.log(spread + 0.003)
    score += of_rim * rim + of_step * step
    return np.where(support > 0.0, 1.0 / (1.0 + np.exp(-score)), 0.0).astype(np.float32)
