"""A lens without distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from typing_extensions import Self

from coliags_plugin.lenses.models import Lens, Pinhole


@dataclass(frozen=True, kw_only=True)
class PinholeLens(Lens):
    """A pinhole camera as a lens.

    Attributes:
        fx, fy: Focal lengths, pixels.
        cx, cy: Principal point, pixels, centres at integers.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of(cls, pinhole: Pinhole, width: int, height: int) -> Self:
        """The lens of intrinsics and an image size, pixels."""
        return cls(width=width, height=height, **pinhole._asdict())

    @property
    def pinhole(self) -> Pinhole:
        """See :class:`Lens`."""
        return Pinhole(self.fx, self.fy, self.cx, self.cy)

    def scaled(self, width: int, height: int) -> Self:
        """See :class:`Lens`."""
        return self.of(self.pinhole.scaled(width / self.width, height / self.height), width, height)

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
