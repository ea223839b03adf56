"""Depth of one frame by sweeping a surface through its neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from coliags_plugin.reconstruction.depth.settings import Sweep
from coliags_plugin.reconstruction.depth.views import Guide, Map

#: Log of the factor on depth over which a hypothesis must have had rivals.
_RIVALS = math.log(2.0)
#: Standard deviation of the noise of log intensity, below which nothing matches.
_NOISE = 0.01
#: Part of the neighbours that counts at a pixel: the best-matching.
_BEST_SHARE = 0.75
#: Semi-global penalty P2 of a change by more than one hypothesis, and how much edges of the log image lower it.
_LARGE_PENALTY, _EDGE_CONTRAST = 1.0, 10.0


@dataclass(frozen=True, eq=False)
class Swept:
    """Depth of one frame from its own sweep."""

    depth: Map  # z-depth
    match: Map  # correlation with the better neighbours, -1 to 1; 0: too few
    margin: Map  # by how much other depths match worse, after aggregation


def ratios(sweep: Sweep, depth_range: tuple[float, float]) -> Float32[np.ndarray, "D"]:
    """Hypotheses as factors on the swept surface, equally spaced in their logarithm.

    The surface of a sweep of the whole range (``reach`` None) is at the nearest depth.
    """
    step = math.log1p(sweep.step)
    if sweep.reach is None:
        span = math.log(depth_range[1] / depth_range[0])
        return np.exp(np.linspace(0.0, span, max(3, math.ceil(span / step) + 1))).astype(np.float32)
    side = max(1, round(math.log1p(sweep.reach) / step))
    return np.exp(step * np.arange(-side, side + 1)).astype(np.float32)


def sweep_frame(
    guide: Guide,
    neighbours: Sequence[Guide],
    base: Map,
    factors: Float32[np.ndarray, "D"],
    sweep: Sweep,
) -> Swept:
    """Match a frame with its neighbours at multiples (ascending) of a surface of z-depth, and take the best.

    Correlation of log intensity in square windows, sampled on the surface itself, so that windows follow its slant;
    semi-global aggregation; a parabola between hypotheses. The neighbours, at least one, are all of one size.
    """
    from coliags_plugin.core.numba_kernels.lanes import WIDTH
    from coliags_plugin.reconstruction.depth.numba_kernels import sweep as kernels

    shape = base.shape
    pairs = [guide.pose.homography(other.pose) for other in neighbours]
    cost = np.full((*shape, WIDTH * math.ceil(len(factors) / WIDTH)), np.inf, np.float32)
    kernels.sweep(
        np.ascontiguousarray(base, np.float32),
        factors,
        guide.intensity,
        guide.usable.astype(np.float32),
        np.stack([other.intensity for other in neighbours]),
        np.stack([other.usable for other in neighbours]).astype(np.uint8),
        np.stack([turn for turn, _ in pairs]),
        np.stack([shift for _, shift in pairs]),
        sweep.radius,
        _NOISE**2,
        _BEST_SHARE,
        cost,
    )
    total = np.empty_like(cost)
    kernels.aggregate(
        cost,
        guide.intensity,
        np.float32(sweep.small_penalty),
        np.float32(_LARGE_PENALTY),
        np.float32(_EDGE_CONTRAST),
        total,
    )
    index, fit, margin = (np.empty(shape, np.float32) for _ in range(3))
    kernels.pick(total, cost, math.ceil(_RIVALS / math.log1p(sweep.step)), index, fit, margin)
    position = np.interp(index.ravel(), np.arange(len(factors)), np.log(factors)).reshape(shape)
    return Swept((base * np.exp(position)).astype(np.float32), fit, margin)
