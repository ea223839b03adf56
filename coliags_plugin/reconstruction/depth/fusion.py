"""Fusion of the depth maps of neighbouring frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from coliags_plugin.reconstruction.depth.views import Pose

#: Iterations until a ray has met a neighbour's surface, and the relative change at which it has.
_ITERATIONS, _CONVERGED = 12, 1e-3


@dataclass(frozen=True, eq=False)
class DepthMap:
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


def fuse_frame(own: DepthMap, neighbours: Sequence[DepthMap], agreement: float) -> Fused:
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
