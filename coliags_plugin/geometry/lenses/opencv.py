"""OpenCV's full pinhole model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coliags_plugin.geometry.lenses.models import Array
from coliags_plugin.geometry.lenses.tabulated import MappedLens


@dataclass(frozen=True, kw_only=True)
class OpenCVLens(MappedLens):
    """A pinhole with radial and tangential distortion, as ``cv2.projectPoints`` has it.

    The tangents (x, y), with r^2 = x^2 + y^2, become

        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)

    and y' likewise with p1 and p2 exchanged (OpenCV, "Camera Calibration and 3D Reconstruction"). fx, fy, cx and cy are
    pixels, centres at integers + 0.5.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @property
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        return self.fx, self.fy, self.cx, self.cy

    def _bent(self, tangents: Array) -> Array:
        # Written out: cv2.projectPoints gives the same to the last digits and takes ten times as long.
        x, y = tangents[:, 0], tangents[:, 1]
        square, product = x * x + y * y, 2.0 * x * y
        numerator = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        denominator = 1.0 + square * (self.k4 + square * (self.k5 + square * self.k6))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            radial = numerator / denominator
            bent_x = x * radial + self.p1 * product + self.p2 * (square + 2.0 * x * x)
            bent_y = y * radial + self.p1 * (square + 2.0 * y * y) + self.p2 * product
        return np.stack([self.fx * bent_x + self.cx, self.fy * bent_y + self.cy], axis=1)
