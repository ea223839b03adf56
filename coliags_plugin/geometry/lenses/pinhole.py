"""A lens without distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from typing_extensions import Self

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.models import Lens


@dataclass(frozen=True)
class PinholeLens(Intrinsics, Lens):
    """A pinhole camera as a lens; attributes as for :class:`Intrinsics`."""

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> Self:
        """The lens of intrinsics."""
        return cls(**vars(intrinsics))

    @property
    def pinhole(self) -> Intrinsics:
        """See :class:`Lens`."""
        return Intrinsics(**vars(self))

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Self:
        """See :class:`Lens`."""
        return replace(self, width=width, height=height, cx=self.cx - x0, cy=self.cy - y0)

    def unproject(self, pixels: ArrayLike) -> Float[np.ndarray, "N 3"]:
        """See :class:`Lens`."""
        pixels = np.asarray(pixels, np.float64)
        x, y = (pixels[:, 0] - self.cx) / self.fx, (pixels[:, 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=1)

    def project(self, points: ArrayLike) -> Float[np.ndarray, "N 2"]:
        """See :class:`Lens`."""
        points = np.asarray(points, np.float64)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        return np.stack([self.fx * points[:, 0] / z + self.cx, self.fy * points[:, 1] / z + self.cy], axis=1)
