"""COLMAP's camera models as lenses, projected by pycolmap."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from coliags_plugin.geometry.lenses.models import Array
from coliags_plugin.geometry.lenses.tabulated import MappedLens

if TYPE_CHECKING:
    import pycolmap

#: Camera models without distortion.
PINHOLES = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})


@dataclass(frozen=True, kw_only=True)
class ColmapLens(MappedLens):
    """A camera of a COLMAP model.

    Attributes:
        model: Its name, for instance ``OPENCV_FISHEYE``.
        params: As COLMAP orders them; pixels, centres at integers + 0.5.
    """

    model: str
    params: tuple[float, ...]

    @cached_property
    def _camera(self) -> pycolmap.Camera:
        import pycolmap

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Along columns and rows, pixels."""
        return self._camera.focal_length_x, self._camera.focal_length_y

    @property
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        return *self.focal_lengths, self._camera.principal_point_x, self._camera.principal_point_y

    def _bent(self, tangents: Array) -> Array:
        points = np.concatenate([tangents, np.ones((len(tangents), 1))], axis=1)
        return np.asarray(self._camera.img_from_cam(points), np.float64)
