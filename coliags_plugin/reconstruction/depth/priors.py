"""Base class of depth priors."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Bool, Float32

from coliags_plugin.core.scenes import Frame


class DepthPrior(ABC):
    """Gives every pixel of a frame a depth, fitted to where depth is known."""

    @abstractmethod
    def log_depth(
        self,
        frame: Frame,
        usable: Bool[np.ndarray, "H W"],
        known: Float32[np.ndarray, "H W"],
        weight: Float32[np.ndarray, "H W"],
        typical: float,
    ) -> Float32[np.ndarray, "H W"]:
        """The prior of a frame, fitted to its known depth.

        Args:
            frame: The frame, of the size of the maps or larger.
            usable: Neither masked nor near a highlight. [H, W]
            known: Log of z-depth; anything where the weight is 0. [H, W]
            weight: Of the known depth, 0 to 1. [H, W]
            typical: z-depth of a typical pixel, for a frame without known depth.

        Returns:
            Log of z-depth at every pixel. [H, W]
        """

    @abstractmethod
    def described(self) -> str:
        """What determines the prior, to tell whether work files are of the same one."""
