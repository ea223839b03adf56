"""Depth of one frame by sweeping a surface through its neighbours, its fusion with theirs, and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32
from pydantic import Field

from coliags_plugin.core.depth_maps import Map, Pose, WeightedDepth, depths_by
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.settings import Settings
from coliags_plugin.reconstruction.structure.features import image_and_mask, usable
from coliags_plugin.reconstruction.structure.sfm_settings import FeatureSettings


class Sweep(NamedTuple):
    """One sweep: matching and aggregation."""

    reduction: int = 1  # factor by which images are reduced
    step: float = 0.03  # relative difference of neighbouring hypotheses
    reach: float | None = None  # relative depth about that of the sweep before; None: the whole depth range
    #: Distances of the neighbours, in units of a frame's median depth; one frame to either side in the video for each.
    baselines: tuple[float, ...] = (0.05, 0.08, 0.12, 0.16, 0.2, 0.25)
    radius: int = 3  # half the width of the correlation windows, pixels
    small_penalty: float = 0.08  # semi-global penalty P1 of a change by one hypothesis; costs are in [0, 2]


#: One after the other; each but the first is about the completed depth of the one before, smoothed.
SWEEPS = (
    Sweep(reduction=2, radius=4),
    Sweep(step=0.01, reach=0.15, baselines=(0.05, 0.1, 0.2, 0.3, 0.4, 0.5), radius=2, small_penalty=0.01),
)
#: Largest distance of a neighbour, and largest angle between its optical axis and the frame's, degrees.
MAX_BASELINE, MAX_TURN = 0.6, 40.0


class DepthEstimationSettings(Settings):
    """Options of depth estimation."""

    agreement: float = Field(
        default=0.02, gt=0.0, lt=0.5, description="Relative difference up to which two frames' depths agree."
    )
    features: FeatureSettings = Field(
        default=FeatureSettings(), description="Features that the depth range is found from, and highlights."
    )


#: A value, and whether one counts, for every pixel of a frame.
Mask = Bool[np.ndarray, "H W"]

#: Added to intensity before the logarithm, which would amplify the noise of dark pixels.
_OFFSET = 0.02


@dataclass(frozen=True, eq=False)
class Guide:
    """An image prepared for matching."""

    pose: Pose  # camera of its size
    intensity: Map  # log of green; comparable up to a constant
    usable: Mask  # neither masked nor near a highlight


def guide_of(frame: Frame, reduction: int, features: FeatureSettings) -> Guide:
    """Prepare a frame, reduced by a factor, for matching; ``features`` says what a highlight is."""
    import cv2

    image, mask = image_and_mask(frame)
    good = usable(image, mask, features)
    height, width = good.shape
    # At least 8 pixels a side, unless it was smaller.
    size = max(min(8, width), round(width / reduction)), max(min(8, height), round(height / reduction))
    green = image[..., 1].astype(np.float32) / 255.0
    if reduction > 1:
        green = cv2.resize(green, size, interpolation=cv2.INTER_AREA)
        good = cv2.resize(good.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    intensity = np.log(green + _OFFSET).astype(np.float32)
    middle = float(intensity[good].mean()) if good.any() else 0.0
    return Guide(Pose.of(frame.camera, size), np.ascontiguousarray(intensity - np.float32(middle)), good)


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
    guide: Guide, neighbours: Sequence[Guide], base: Map, factors: Float32[np.ndarray, "D"], sweep: Sweep
) -> Swept:
    """Match a frame with its neighbours at multiples (ascending) of a surface of z-depth, and take the best.

    Correlation of log intensity in square windows, sampled on the surface itself, so that windows follow its slant;
    semi-global aggregation; a parabola between hypotheses. The neighbours, at least one, are all of one size.
    """
    from coliags_plugin.core.numba_kernels.lanes import WIDTH
    from coliags_plugin.reconstruction.depth.numba_kernels import kernels

    shape = base.shape
    turns, shifts = zip(*(guide.pose.homography(other.pose) for other in neighbours), strict=True)
    images = np.stack([other.intensity for other in neighbours])
    masks = np.stack([other.usable for other in neighbours]).astype(np.uint8)
    surface = np.ascontiguousarray(base, np.float32), factors, guide.intensity, guide.usable.astype(np.float32)
    places = np.stack(turns), np.stack(shifts)
    cost = np.full((*shape, WIDTH * math.ceil(len(factors) / WIDTH)), np.inf, np.float32)
    kernels.sweep(*surface, images, masks, *places, sweep.radius, _NOISE**2, _BEST_SHARE, cost)
    total = np.empty_like(cost)
    small, large, contrast = np.float32(sweep.small_penalty), np.float32(_LARGE_PENALTY), np.float32(_EDGE_CONTRAST)
    kernels.aggregate(cost, guide.intensity, small, large, contrast, total)
    index, fit, margin = (np.empty(shape, np.float32) for _ in range(3))
    kernels.pick(total, cost, math.ceil(_RIVALS / math.log1p(sweep.step)), index, fit, margin)
    position = np.interp(index.ravel(), np.arange(len(factors)), np.log(factors)).reshape(shape)
    return Swept((base * np.exp(position)).astype(np.float32), fit, margin)


def fuse_frame(frame: WeightedDepth, neighbours: Sequence[WeightedDepth], agreement: float) -> tuple[Map, Map, Map]:
    """Weighted median of the depths that a frame and its neighbours give to each pixel, within the densest group.

    Depths agree up to a relative difference of ``agreement``.

    Returns the z-depth, the frame's own where no other counts; the weight of the frames that agree with it; and the
    mean relative deviation within the group.
    """
    from coliags_plugin.reconstruction.depth.numba_kernels.kernels import vote

    depth, candidates, trusts = depths_by(neighbours, frame)
    weight = np.pad(frame.weight.ravel(), (0, len(depth) - frame.weight.size))
    written = np.empty((3, len(depth)), np.float32)
    vote(depth, weight, candidates, trusts, np.float32(agreement), *written)
    fused, votes, spread = written[:, : frame.depth.size].reshape(3, *frame.depth.shape)
    return fused, votes, spread


#: Largest difference of log depth that counts: beyond, one frame may see what is hidden from the other.
_HIDDEN = 0.1


def disagreement(frame: WeightedDepth, neighbours: Sequence[WeightedDepth]) -> float:
    """Mean difference of a frame's log depth from its neighbours', each up to 0.1; infinite if none sees its pixels."""
    depth, candidates, _ = depths_by(neighbours, frame)
    ratio = (candidates / depth)[np.isfinite(candidates)]
    return float(np.minimum(np.abs(np.log(ratio)), _HIDDEN).mean()) if len(ratio) else math.inf


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
