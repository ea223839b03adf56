"""How z-depth is written down: each format keeps its own numbers until they are used."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from coliags_plugin.datamanagers.reading.images import read_gray


class DepthFormat(ABC):
    """Depth files of one kind. 0 means unknown in all of them: it is what undistortion fills in."""

    @abstractmethod
    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """A file's numbers as stored.

        Raises:
            InputError: It cannot be read whole, or is of another kind.
        """

    @abstractmethod
    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """z-depth of stored numbers, scene units; NaN where unknown."""

    def clipped_at(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"] | None:
        """Where the format's range ends and the surface lies there or beyond, the range; NaN elsewhere.

        None where nothing is clipped.
        """
        return None


@dataclass(frozen=True)
class DepthSteps(DepthFormat):
    """Whole numbers, proportional to z-depth.

    Attributes:
        size: Scene units a step.
        bits: 8 or 16.
        far: The number that means "this far or farther"; None where there is none.
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


#: C3VD's own: 100 mm in 16 bits; nothing is farther.
C3VD_DEPTH = DepthSteps(100.0 / 65535.0, 16, 65535)
