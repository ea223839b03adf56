"""Rectification of pictures from many lenses, each undistorted when it is read.

A :class:`Rectification` of its own for every camera would hold its undistortion maps for as long as the scene lives:
some 10 MB each, and COLMAP likes to give every picture a camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.datamanagers.rectification import Rectification, undistorted_camera
from coliags_plugin.lenses.models import Lens
from coliags_plugin.lenses.undistortion import Undistortion

#: Undistortions kept at a time: as many as pictures are read side by side.
_KEPT = 8

Undistorter = Callable[[Lens, Intrinsics], Undistortion]


def undistorter() -> Undistorter:
    """Makes undistortions, and keeps the latest few."""
    return lru_cache(maxsize=_KEPT)(Undistortion)


@dataclass(frozen=True, kw_only=True)
class LensRectification(Rectification):
    """A rectification of pictures through a lens that holds no maps.

    Attributes:
        lens: Of the stored pictures.
        undistort: Where its undistortion comes from, shared by those of a scene.
    """

    lens: Lens
    undistort: Undistorter

    @classmethod
    def of(
        cls, lens: Lens, described_by: Path, size: tuple[int, int], focal_scale: float, undistort: Undistorter
    ) -> LensRectification:
        """As :meth:`Rectification.through`."""
        return cls(
            source_width=lens.width,
            source_height=lens.height,
            pinhole=undistorted_camera(lens, size, focal_scale),
            described_by=described_by,
            lens=lens,
            undistort=undistort,
        )

    def image(self, rgb: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """See :class:`Rectification`."""
        return self._made.image(rgb)

    def nearest(self, values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "h w"]:
        """See :class:`Rectification`."""
        return self._made.nearest(values, 0)

    def pixels(self, stored: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 2"]:
        """See :class:`Rectification`."""
        k = self.pinhole
        return np.asarray(self.lens.unproject(stored)[:, :2] * (k.fx, k.fy) + (k.cx, k.cy))

    @property
    def valid(self) -> Bool[np.ndarray, "h w"] | None:
        """See :class:`Rectification`."""
        valid = self._made.valid
        return None if valid.all() else valid

    @property
    def _made(self) -> Undistortion:
        return self.undistort(self.lens, self.pinhole)
