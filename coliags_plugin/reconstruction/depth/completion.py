"""Completion of depth where it is not known: prior plus a smooth residual."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from coliags_plugin.reconstruction.depth.views import Map, Mask

#: Fast global smoother: strength, and the difference of the 8-bit guide at which smoothing ceases.
_STRENGTH, _EDGE = 10.0, 12.0
#: The same of surfaces that are swept.
_SURFACE_STRENGTH, _SURFACE_EDGE = 10.0, 6.0
#: Grey levels of the guide for each unit of log intensity.
_LEVELS = 60.0
#: Weight of a residual of zero at every pixel, relative to a known pixel's one.
_ZERO = 1e-4
#: Log depth across 5 pixels from which they are at a depth edge, and how much is believed of its near side.
_JUMP, _BELIEF = 0.06, 0.1
#: Support below which depth is not believed if it is off the prior by more than this, in log depth.
_FEW, _ABSURD = 1.5, 0.35


def complete(log_known: Map, support: Map, belief: Map, log_prior: Map, intensity: Map) -> Map:
    """Log depth that keeps to what is known and elsewhere is the prior plus a smooth residual.

    The residual is known depth minus prior, spread by an edge-aware global smoother (Min et al. 2014) normalised by
    the spread weight. Depth that several frames agree on is kept; what has less support is mixed with the smooth one.
    ``support`` is the weighted number of frames that agree, 0 where depth is unknown; ``belief``, 0 to 1, how much of
    it counts; edges of the log ``intensity`` stop the smoothing.
    """
    data = data_weight(support) * belief
    smooth = _smoother(intensity, _STRENGTH, _EDGE)
    residual = np.where(data > 0.0, log_known - log_prior, 0.0).astype(np.float32)
    filled = log_prior + smooth(data * residual) / (smooth(data) + np.float32(_ZERO))
    position = np.clip((support - 0.2) / 0.8, 0.0, 1.0)
    kept = position * position * (3.0 - 2.0 * position) * belief
    return np.asarray(np.where(kept > 0.0, kept * log_known + (1.0 - kept) * filled, filled), np.float32)


def first_belief(log_known: Map, support: Map, log_prior: Map, rim: Mask) -> Map:
    """How much of a sweep without a surface to start from is believed, 0 to 1.

    Large windows make a near surface too wide at its edges: there, its rim (:func:`near_rim`) has little weight, and
    the edges of the image decide. Depth with little support that is far off the prior is not believed.
    """
    absurd = (support < _FEW) & (np.abs(log_known - log_prior) > _ABSURD)
    return np.where(absurd, 0.0, np.where(rim, _BELIEF, 1.0)).astype(np.float32)


def smooth_surface(depth: Float32[np.ndarray, "h w"], intensity: Map) -> Map:
    """z-depth at the size of a log image and smoothed up to its edges, as a surface to sweep.

    Windows of correlation lie on the surface: where its slant is wrong, so is what they find.
    """
    import cv2

    resized = cv2.resize(depth, intensity.shape[::-1], interpolation=cv2.INTER_LINEAR)
    log_depth = np.log(resized.astype(np.float32))
    return np.asarray(np.exp(_smoother(intensity, _SURFACE_STRENGTH, _SURFACE_EDGE)(log_depth)), np.float32)


def data_weight(support: Map) -> Map:
    """Weight of known depth beside other known depth, where priors are fitted and residuals spread: 0 to 1."""
    return np.where(support > 0.0, np.minimum(0.3 + support, 1.0), 0.0).astype(np.float32)


def near_rim(log_depth: Map, reach: int) -> Mask:
    """Pixels on the near side of a depth edge, within ``reach`` pixels of it."""
    import cv2

    values = cv2.medianBlur(log_depth, 5)
    small, wide = (np.ones((2 * side + 1, 2 * side + 1), np.uint8) for side in (2, reach))
    edge = (cv2.dilate(values, small) - cv2.erode(values, small) > _JUMP).astype(np.uint8)
    middle = 0.5 * (cv2.dilate(values, wide) + cv2.erode(values, wide))
    return np.asarray((cv2.dilate(edge, wide) > 0) & (values < middle))


def _smoother(intensity: Map, strength: float, edge: float) -> Callable[[Map], Map]:
    """An edge-aware global smoother (Min et al. 2014) guided by log intensity."""
    import cv2

    guide = np.clip(128.0 + _LEVELS * intensity, 0, 255).astype(np.uint8)
    return cv2.ximgproc.createFastGlobalSmootherFilter(guide, strength, edge).filter
