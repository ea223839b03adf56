"""Resampling of images of a lens to those of a pinhole camera."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from coliags_plugin.core.arrays import eroded
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.lenses.models import Lens

#: Where :func:`undistortion_map` sends pixels that no source pixel shows: outside any image, whatever the border.
NOWHERE = -10.0


def undistortion_map(lens: Lens, pinhole: Intrinsics) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Map for ``cv2.remap``: column and row in the distorted image of each pixel of a pinhole image.

    Unlike elsewhere, pixel centres are at INTEGERS, as OpenCV counts. Places may lie outside the distorted image, and
    are :data:`NOWHERE` where the lens does not reach.
    """
    k = pinhole
    x, y = np.meshgrid((np.arange(k.width) + 0.5 - k.cx) / k.fx, (np.arange(k.height) + 0.5 - k.cy) / k.fy)
    pixels = lens.project(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)) - 0.5
    pixels = np.where(np.isnan(pixels), NOWHERE, pixels).astype(np.float32)
    return pixels[:, 0].reshape(k.height, k.width), pixels[:, 1].reshape(k.height, k.width)


#: Bilinear samples per source pixel along each side, at most. Half the nominal focal length takes two; more would be
#: taken only where the lens is described wrongly, and fill the memory.
_MOST_SAMPLES = 2.0


class Undistortion:
    """Resampling of the images of one lens to those of one pinhole camera.

    Where one pixel of the result covers several source pixels, its colour is the mean of ``supersampling`` x
    ``supersampling`` bilinear samples spread over it, which avoids aliasing. Values that must not be mixed (depth,
    masks) are taken from the nearest source pixel, in their own type. z-depth needs no conversion: both cameras share
    their optical axis. ``valid`` are result pixels made only of source pixels with image content, ``source_mask``.
    """

    def __init__(
        self, lens: Lens, pinhole: Intrinsics, source_mask: Bool[np.ndarray, "H_source W_source"] | None = None
    ) -> None:
        self.lens = lens
        self.source_mask = source_mask
        self.width, self.height = width, height = pinhole.width, pinhole.height
        self._columns, self._rows = undistortion_map(lens, pinhole)
        # Source pixels per result pixel where the map is coarsest, leaving out the rim it does not reach.
        steps = [np.hypot(np.diff(self._columns, axis=axis), np.diff(self._rows, axis=axis)) for axis in (0, 1)]
        step = float(np.quantile(np.concatenate([side.ravel() for side in steps]), 0.95)) if width * height > 1 else 1.0
        most = math.ceil(_MOST_SAMPLES * max(lens.width / width, lens.height / height))
        self.supersampling = s = max(1, min(round(step), most))
        self._fine_columns, self._fine_rows = self._columns, self._rows
        if s > 1:
            fine = pinhole.resized(width * s, height * s)
            self._fine_columns, self._fine_rows = undistortion_map(lens, fine)
        # Bilinear neighbours of the outermost pixels show nothing.
        shows = np.ones((lens.height, lens.width), bool) if source_mask is None else eroded(source_mask, 1)
        fine_valid = self._pick(shows, self._fine_columns, self._fine_rows, False)
        self.valid: np.ndarray = np.all(fine_valid.reshape(height, s, width, s), axis=(1, 3))

    def image(self, rgb: UInt8[np.ndarray, "H_source W_source 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Resample a colour image. Pixels outside :attr:`valid` are mixed with the image's border."""
        import cv2

        fine = cv2.remap(rgb, self._fine_columns, self._fine_rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if self.supersampling > 1:
            # A whole-number INTER_AREA is the exact mean of each block.
            fine = cv2.resize(fine, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(fine, np.uint8)

    def nearest(self, values: Shaped[np.ndarray, "H_source W_source"], fill: float) -> Shaped[np.ndarray, "H W"]:
        """Values of the nearest source pixels, unmixed and of the same type; ``fill`` where there is no source."""
        return self._pick(values, self._columns, self._rows, fill)

    def _pick(self, values: np.ndarray, columns: np.ndarray, rows: np.ndarray, fill: float) -> np.ndarray:
        column, row = np.rint(columns).astype(np.int64), np.rint(rows).astype(np.int64)
        inside = (column >= 0) & (column < self.lens.width) & (row >= 0) & (row < self.lens.height)
        picked = np.full(columns.shape, fill, values.dtype)
        picked[inside] = values[row[inside], column[inside]]
        return picked
