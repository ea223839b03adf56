"""Probability that an estimated depth is right."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

from coliags_plugin.reconstruction.depth.sweeping import Swept

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
