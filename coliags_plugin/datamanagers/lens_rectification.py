"""Rectification of images from many lenses, without keeping the undistortion maps of all of them.

A :class:`Rectification` for every camera would hold its undistortion maps of some 10 MB for the lifetime of the scene,
and COLMAP models often have one camera per image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped, UInt8

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.datamanagers.rectification import Rectification, undistorted_camera
from coliags_plugin.geometry.lenses.models import Lens
from coliags_plugin.geometry.lenses.undistortion import Undistortion

#: Undistortions kept at a time: as many as images are read in parallel.
_KEPT = 8

Undistorter = Callable[[Lens, Intrinsics], Undistortion]


def undistorter() -> Undistorter:
    """Factory of undistortions with a cache of the latest few."""
    return lru_cache(maxsize=_KEPT)(Undistortion)


@dataclass(frozen=True, kw_only=True)
class LensRectification(Rectification):
    """Rectification of images through a lens that holds no maps.

    Attributes:
        lens: Of the stored images.
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

    @property
    def stored_lens(self) -> Lens:
        """See :class:`Rectification`."""
        return self.lens

    def image(self, rgb: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """See :class:`Rectification`."""
        return self._made.image(rgb)

    def nearest(self, values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "h w"]:
        """See :class:`Rectification`."""
        return self._made.nearest(values, 0)

    @property
    def valid(self) -> Bool[np.ndarray, "h w"] | None:
        """See :class:`Rectification`."""
        valid = self._made.valid
        return None if valid.all() else valid

    @property
    def _made(self) -> Undistortion:
        return self.undistort(self.lens, self.pinhole)
