"""Intrinsics of a pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from typing_extensions import Self

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError

#: z-depth of the near plane where nothing else is set, scene units: the splatting methods' (docs/methods.md 2.1).
NEAR_PLANE = 0.2


@dataclass(frozen=True)
class Intrinsics:
    """An undistorted pinhole camera without its pose.

    Pixel centres lie at integers + 0.5, so pixel (column i, row j) sees image point (i + 0.5, j + 0.5). Files and
    libraries that count them at integers are converted where they are read, written or called.

    Attributes:
        fx, fy: Focal lengths, pixels.
        cx, cy: Principal point, pixels, centres at integers + 0.5. Need not be the image centre.
        width, height: Image size, pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite or absurdly large, and focal lengths or sizes that are not positive."""
        numbers = (self.fx, self.fy, self.cx, self.cy)
        good = all(abs(number) <= bounds.PIXELS for number in numbers)  # NaN is not
        good = good and min(self.fx, self.fy) > 0.0 and self._slope <= bounds.SLOPE
        if not good or not all(0 < side <= bounds.IMAGE_SIDE for side in (self.width, self.height)):
            raise InputError(
                f"intrinsics fx {self.fx:g}, fy {self.fy:g}, cx {self.cx:g}, cy {self.cy:g} "
                f"of an image {self.width} x {self.height}",
                f"numbers in pixels up to {bounds.PIXELS:g}, focal lengths and size positive, size up to "
                f"{bounds.IMAGE_SIDE}, rays within {math.degrees(math.atan(bounds.SLOPE)):.1f} degrees of the axis",
            )

    @property
    def _slope(self) -> float:
        """Largest tangent of the angle between the axis and a ray, along x or y."""
        across = max(abs(self.cx), abs(self.width - self.cx)) / self.fx
        return max(across, max(abs(self.cy), abs(self.height - self.cy)) / self.fy)

    def resized(self, width: int, height: int) -> Self:
        """Intrinsics of the view sampled at another size, pixels; the image's edges stay where they are."""
        x, y = width / self.width, height / self.height
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height)

    def opencv_matrix(self) -> Float[np.ndarray, "3 3"]:
        """K for pixel centres at integers, as in OpenCV, open3d and EndoGSLAM's files."""
        return np.array([[self.fx, 0.0, self.cx - 0.5], [0.0, self.fy, self.cy - 0.5], [0.0, 0.0, 1.0]])
