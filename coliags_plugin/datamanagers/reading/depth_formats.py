"""Depth file formats: reading stored values and converting them to z-depth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from coliags_plugin.datamanagers.reading.images import read_gray


class DepthFormat(ABC):
    """Interface of depth file formats. The stored value 0 means unknown in all of them; undistortion fills it in."""

    @abstractmethod
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """Read the stored values of a file.

        Raises:
            InputError: The file is damaged or has another format.
        """

    @abstractmethod
    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Convert stored values to z-depth, scene units; NaN where unknown."""

    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        """Lower bound of z-depth at pixels clipped to the format's range, NaN elsewhere; None if none is clipped."""
        return None


@dataclass(frozen=True)
class DepthSteps(DepthFormat):
    """Integers proportional to z-depth.

    Attributes:
        size: Scene units per step.
        bits: 8 or 16.
        far: Stored value of depths clipped to the range; None where there is none.
    """

    size: float
    bits: int = 16
    far: int | None = None

    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """See :class:`DepthFormat`; an image of one channel."""
        return read_gray(path, self.bits, f"a one-channel {self.bits}-bit depth image")

    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """See :class:`DepthFormat`."""
        depth = (stored * self.size).astype(np.float32)
        depth[(stored == 0) if self.far is None else (stored == 0) | (stored == self.far)] = np.nan
        return depth

    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        """See :class:`DepthFormat`."""
        if self.far is None or not (clipped := stored == self.far).any():
            return None
        return np.where(clipped, np.float32(self.far * self.size), np.float32(np.nan))


#: C3VD's format: 16 bits for 100 mm, clipped beyond.
C3VD_DEPTH = DepthSteps(100.0 / 65535.0, 16, 65535)
