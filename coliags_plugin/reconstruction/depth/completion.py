"""Completion of depth where it is not known: prior plus a smooth residual."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

#: Fast global smoother: strength, and the difference of the 8-bit guide at which smoothing ceases.
_STRENGTH, _EDGE = 2000.0, 12.0
#: Grey levels of the guide for each unit of log intensity.
_LEVELS = 60.0
#: Weight of a residual of zero at every pixel, relative to a known pixel's one.
_ZERO = 1e-4


def complete(
    log_known: Float32[np.ndarray, "H W"],
    weight: Float32[np.ndarray, "H W"],
    log_prior: Float32[np.ndarray, "H W"],
    intensity: Float32[np.ndarray, "H W"],
) -> Float32[np.ndarray, "H W"]:
    """Log depth that keeps to what is known and elsewhere is the prior plus a smooth residual.

    The residual is known depth minus prior, spread by an edge-aware global smoother (Min et al. 2014) normalised by
    the spread weight. Between known and unknown, depth is mixed by the weight.

    Args:
        log_known: Log of z-depth; anything where the weight is 0. [H, W]
        weight: 0 to 1. [H, W]
        log_prior: Log of z-depth by the prior. [H, W]
        intensity: Log intensity, whose edges stop the smoothing. [H, W]
    """
    import cv2

    guide = np.clip(128.0 + _LEVELS * intensity, 0, 255).astype(np.uint8)
    smooth = cv2.ximgproc.createFastGlobalSmootherFilter(guide, _STRENGTH, _EDGE)
    residual = np.where(weight > 0.0, log_known - log_prior, 0.0).astype(np.float32)
    spread = smooth.filter(weight * residual) / (smooth.filter(weight) + np.float32(_ZERO))
    filled = log_prior + spread
    return np.asarray(np.where(weight > 0.0, weight * log_known + (1.0 - weight) * filled, filled), np.float32)
