"""z-depth in ``.npy`` files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from coliags_plugin.core.arrays import read_array
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.depth_formats import DepthFormat, DepthSteps


@dataclass(frozen=True)
class DepthArray(DepthFormat):
    """An ``.npy`` array [H, W] or [H, W, 1] of real numbers; 0, negative and not finite mean unknown.

    Attributes:
        size: Scene units per stored unit.
    """

    size: float

    def read(self, path: Path) -> Shaped[np.ndarray, "H W"]:
        """See :class:`DepthFormat`."""
        expected = "an .npy array [H, W] of real numbers"
        array = read_array(path, expected)
        if array.ndim == 3 and array.shape[2] == 1:
            array = array[..., 0]
        real = np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)
        if array.ndim != 2 or not array.size or not real:
            raise InputError(f"{path} is an array {list(array.shape)} of {array.dtype}", expected)
        return np.asarray(array)

    def z_depth(self, stored: Shaped[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """See :class:`DepthFormat`."""
        with np.errstate(over="ignore"):
            depth = (stored * self.size).astype(np.float32)
        depth[~(np.isfinite(depth) & (depth > 0.0))] = np.nan
        return depth


def depth_format(path: Path, size: float) -> DepthFormat:
    """Depth format by file suffix: ``.npy``, else 16-bit images; ``size`` in scene units per stored unit."""
    return DepthArray(size) if path.suffix.lower() == ".npy" else DepthSteps(size, 16)
