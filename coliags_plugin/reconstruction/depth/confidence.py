"""Probability that an estimated depth is right."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from coliags_plugin.reconstruction.depth.fusion import Fused
from coliags_plugin.reconstruction.depth.sweeping import Swept


def sweep_weight(swept: Swept) -> Float32[np.ndarray, "H W"]:
    """Weight of a frame's own depth in fusion, 0 to 1. [H, W]"""
    quality = np.clip((swept.match - 0.2) / 0.6, 0.0, 1.0) * np.clip(swept.margin / 1.0, 0.0, 1.0)
    return np.asarray(np.where(swept.match > 0.0, 0.05 + 0.95 * quality, 0.0), np.float32)


def fused_confidence(fused: Fused, match: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Estimated probability that a fused depth is off by less than 5 %. [H, W]"""
    others = np.maximum(fused.votes, 1e-3)
    score = -2.0 + 1.5 * np.log(others) - 3.0 * fused.against / (fused.votes + fused.against + 1e-3) + 2.0 * match
    return np.asarray(1.0 / (1.0 + np.exp(-score)), np.float32)


def known_weight(confidence: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Weight of a fused depth beside what completion would fill in, 0 to 1. [H, W]"""
    position = np.clip((confidence - 0.3) / 0.4, 0.0, 1.0)
    return np.asarray(position * position * (3.0 - 2.0 * position), np.float32)
