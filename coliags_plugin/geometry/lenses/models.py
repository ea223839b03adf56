"""Lenses, between pixels of an image and viewing directions: a pinhole, and those that C3VD is read through.

Everything here is float64 and counts pixel centres at integers + 0.5, as :class:`Intrinsics` does.
Directions are in camera axes: x right, y down, z forward.

Three calibrations of one colonoscope are in use for the same 1350 x 1080 frames (docs/layouts/c3vd.md 2).
``omnidirectional`` rendered the ground truth. Within 560 pixels of the centre ``fisheye`` is within 0.2 degrees of
it, and ``legacy-pinhole``, behind most published numbers, off by up to 3.4 degrees (2.3 of them along the radius).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt8
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from coliags_plugin.core import bounds
from coliags_plugin.core.arrays import eroded
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics

Array = NDArray[np.float64]

#: Largest magnitudes of the numbers of a lens that are not terms of its distortion.
_LIMITS = dict.fromkeys(("fx", "fy", "cx", "cy", "stretch", "origin"), bounds.PIXELS)
_LIMITS |= dict.fromkeys(("width", "height"), float(bounds.IMAGE_SIDE))
#: Where :func:`undistortion_map` sends pixels that no source pixel shows: outside any image, whatever the border.
NOWHERE = -10.0
#: Terms of a polynomial up to this change nothing at any radius of an image, but overflow where one is divided by.
_NEGLIGIBLE = 1e-100


class Lens(ABC):
    """A camera without its pose: between pixels of one image and viewing directions. Sizes in pixels."""

    width: int
    height: int

    @abstractmethod
    def resized(self, width: int, height: int) -> Self:
        """The lens of the same image resampled to another size; the image's edges stay where they are."""

    @abstractmethod
    def cropped(self, x0: int, y0: int, width: int, height: int) -> Self:
        """The lens of the part of the image whose top left pixel is (x0, y0)."""

    @abstractmethod
    def unproject(self, pixels: ArrayLike) -> Float[np.ndarray, "N 3"]:
        """Viewing directions of pixels, (column, row).

        They have z = 1, so that a point at z-depth ``z`` is ``z * direction``; NaN where the model does not reach: at
        90 degrees or beyond, or past its turning point.
        """

    @abstractmethod
    def project(self, points: ArrayLike) -> Float[np.ndarray, "N 2"]:
        """Pixels, (column, row), of points in camera axes, inside the image or not.

        NaN where the model does not reach and for points not in front of the camera.
        """

    def shows(
        self, points: Float[np.ndarray, "N 3"], mask: Bool[np.ndarray, "H W"] | None = None
    ) -> Bool[np.ndarray, "N"]:
        """Whether points in camera axes fall into the image and, where there is a mask, on its pixels."""
        pixels = self.project(points)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((pixels >= 0.0) & (pixels < (self.width, self.height))).all(axis=1))
        if mask is not None:
            column, row = np.where(inside[:, None], pixels, 0.0).astype(int).T
            inside &= mask[row, column]
        return inside

    @property
    @abstractmethod
    def pinhole(self) -> Intrinsics:
        """The pinhole camera this lens nominally is: what an undistorted image of the same size is given."""


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


@dataclass(frozen=True, kw_only=True)
class CalibratedLens(Lens):
    """A lens with distortion, seen through an image that may be a scaled or cropped copy of the calibrated one.

    The calibration itself is never rescaled: pixels are first carried back to the calibrated image, so that
    scaling and cropping are exact for every model.
    """

    width: int
    height: int
    stretch: tuple[float, float] = (1.0, 1.0)  # pixels of the calibrated image per pixel of this one, (x, y)
    # Where this image's top left corner lies in the calibrated image, pixels from its corner, (x, y).
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite or absurdly large."""
        for each in fields(self):
            value, limit = getattr(self, each.name), _LIMITS.get(each.name, bounds.DISTORTION)
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, (int, float)) and not abs(number) <= limit:  # NaN is not
                    raise InputError(f"a lens with {each.name} {number:g}", f"at most {limit:g} in magnitude")

    def resized(self, width: int, height: int) -> Self:
        """See :class:`Lens`."""
        x, y = self.width / width, self.height / height
        return replace(self, width=width, height=height, stretch=(self.stretch[0] * x, self.stretch[1] * y))

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Self:
        """See :class:`Lens`."""
        origin = (self.origin[0] + self.stretch[0] * x0, self.origin[1] + self.stretch[1] * y0)
        return replace(self, width=width, height=height, origin=origin)

    def unproject(self, pixels: ArrayLike) -> Float[np.ndarray, "N 3"]:
        """See :class:`Lens`."""
        calibrated = np.asarray(pixels, np.float64) * self.stretch + self.origin
        xy = self._tangents(calibrated)
        return np.concatenate([xy, np.where(np.isnan(xy[:, :1]), np.nan, 1.0)], axis=1)

    def project(self, points: ArrayLike) -> Float[np.ndarray, "N 2"]:
        """See :class:`Lens`."""
        points = np.asarray(points, np.float64)
        z = points[:, 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            tangents = np.where(z > 0.0, points[:, :2] / z, np.nan)
        return (self._calibrated_pixels(tangents) - self.origin) / self.stretch

    @property
    def pinhole(self) -> Intrinsics:
        """See :class:`Lens`."""
        fx, fy, cx, cy = self._calibrated_pinhole
        x, y = 1.0 / self.stretch[0], 1.0 / self.stretch[1]
        center = (cx - self.origin[0]) * x, (cy - self.origin[1]) * y
        return Intrinsics(fx * x, fy * y, *center, self.width, self.height)

    @property
    @abstractmethod
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx and cy of the nominal pinhole in the calibrated image."""

    @abstractmethod
    def _tangents(self, pixels: Array) -> Array:
        """(x / z, y / z) of pixels of the calibrated image. [N, 2]"""

    @abstractmethod
    def _calibrated_pixels(self, tangents: Array) -> Array:
        """Inverse of :meth:`_tangents`. [N, 2]"""


@dataclass(frozen=True, kw_only=True)
class OmnidirectionalLens(CalibratedLens):
    """Scaramuzza's polynomial model, with which C3VD's ground truth was rendered (docs/layouts/c3vd.md 2).

    A pixel (u, v) lies at ``A q + (cx, cy)``, and its ray is ``(q_x, q_y, a0 + a2 rho^2 + a3 rho^3 + a4 rho^4)`` with
    ``rho = |q|``; all but the affine part A are pixels.

    The source says ``c, d, e`` and leaves the order open. ``A = [[c, e], [d, 1]]``, as C3VD's renderer fills it, column
    by column: depth and normals were rendered so, and poses registered to them. C3VD's example loader has
    ``[[c, d], [e, 1]]``, which is this lens with ``d`` and ``e`` exchanged. As d is nearly -e, the two differ by a turn
    of the image of 0.33 degrees about its centre: up to 3.9 pixels at the left and right edges. Tracks through real
    frames, triangulated with C3VD's poses, agree better with the renderer's (docs/layouts/c3vd.md 2).
    """

    cx: float
    cy: float
    a0: float
    a2: float
    a3: float
    a4: float
    c: float
    d: float
    e: float

    @property
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        return self.a0, self.a0, self.cx, self.cy

    @property
    def _affine(self) -> Array:
        return np.array([[self.c, self.e], [self.d, 1.0]])

    def _height(self, rho: Array) -> Array:
        return self.a0 + rho**2 * (self.a2 + rho * (self.a3 + rho * self.a4))

    @property
    def _rim(self) -> float:
        """The radius seen at 90 degrees."""
        return _first_root([self.a0, 0.0, self.a2, self.a3, self.a4])

    def _tangents(self, pixels: Array) -> Array:
        q = (pixels - (self.cx, self.cy)) @ np.linalg.inv(self._affine).T
        rho = np.linalg.norm(q, axis=1, keepdims=True)
        height = self._height(rho)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where((rho < self._rim) & (height > 0.0), q / height, np.nan)

    def _calibrated_pixels(self, tangents: Array) -> Array:
        tangent = np.linalg.norm(tangents, axis=1)
        # rho = tangent * height(rho), divided by sqrt(1 + tangent^2) so that grazing rays stay well scaled.
        cosine = 1.0 / np.hypot(1.0, tangent)

        def slope(rho: Array) -> Array:
            rise = rho * (2.0 * self.a2 + rho * (3.0 * self.a3 + rho * 4.0 * self.a4))
            return cosine * (1.0 - tangent * rise)

        upper = np.where(np.isnan(tangent), np.nan, self._rim)
        rho = _solve_increasing(lambda rho: cosine * (rho - tangent * self._height(rho)), slope, upper)
        return along(tangents, tangent, rho, self.a0) @ self._affine.T + (self.cx, self.cy)


@dataclass(frozen=True, kw_only=True)
class _FocalLens(CalibratedLens):
    """A radial distortion ``r (1 + k1 r^2 + k2 r^4 + ...)`` in front of a pinhole camera: fx, fy, cx, cy in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float

    @property
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        return self.fx, self.fy, self.cx, self.cy

    @property
    def _terms(self) -> tuple[float, ...]:
        """k1, k2, ..."""
        return self.k1, self.k2

    def _bent(self, radius: Array) -> Array:
        """The radius after distortion; increasing up to :attr:`_turning_point`."""
        square = radius**2
        *others, last = self._terms
        factor = np.full_like(square, last)
        for term in reversed(others):
            factor = term + square * factor
        return radius * (1.0 + square * factor)

    def _bent_slope(self, radius: Array) -> Array:
        """Derivative of :meth:`_bent`."""
        square = radius**2
        *others, last = self._terms
        slope = square * (2.0 * len(self._terms) + 1.0) * last
        for degree, term in reversed(list(enumerate(others, start=1))):
            slope = square * ((2.0 * degree + 1.0) * term + slope)
        return 1.0 + slope

    @property
    def _turning_point(self) -> float:
        """Up to where :meth:`_bent` increases; infinite where it always does."""
        slope = [(2.0 * degree + 1.0) * term for degree, term in enumerate((1.0, *self._terms))]
        return float(np.sqrt(_first_root(slope)))

    @abstractmethod
    def _radius_of_tangent(self, tangent: Array) -> Array:
        """The radius that the model bends: the tangent itself or its angle."""

    @abstractmethod
    def _tangent_of_radius(self, radius: Array) -> Array:
        """Inverse of :meth:`_radius_of_tangent`."""

    def _tangents(self, pixels: Array) -> Array:
        bent = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        target = np.linalg.norm(bent, axis=1)
        upper = np.full_like(target, self._turning_point)
        if np.isinf(self._turning_point):
            # No natural end for the bracket: let it grow until it holds the answer.
            upper = np.where(np.isfinite(target), 1.0, np.nan)
            while np.any(short := self._bent(upper) < target):
                upper[short] *= 2.0
        upper = np.where(target <= self._bent(upper), upper, np.nan)
        radius = _solve_increasing(lambda radius: self._bent(radius) - target, self._bent_slope, upper)
        return along(bent, target, self._tangent_of_radius(radius), 1.0)

    def _calibrated_pixels(self, tangents: Array) -> Array:
        tangent = np.linalg.norm(tangents, axis=1)
        radius = self._radius_of_tangent(tangent)
        bent = np.where(radius < self._turning_point, self._bent(radius), np.nan)
        return along(tangents, tangent, bent, 1.0) * (self.fx, self.fy) + (self.cx, self.cy)


@dataclass(frozen=True, kw_only=True)
class BrownLens(_FocalLens):
    """OpenCV's pinhole with radial distortion: r is the tangent."""

    def _radius_of_tangent(self, tangent: Array) -> Array:
        return tangent

    def _tangent_of_radius(self, radius: Array) -> Array:
        return radius


@dataclass(frozen=True, kw_only=True)
class FisheyeLens(_FocalLens):
    """OpenCV's fisheye (Kannala-Brandt), with four terms: r is the angle, radians."""

    k3: float
    k4: float

    @property
    def _terms(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @property
    def _turning_point(self) -> float:
        return min(super()._turning_point, np.pi / 2.0)

    def _radius_of_tangent(self, tangent: Array) -> Array:
        return np.arctan(tangent)

    def _tangent_of_radius(self, radius: Array) -> Array:
        return np.tan(radius)


# C3VD and REIM-NeRF count pixel centres at integers: hence + 0.5.
LENSES: dict[str, Lens] = {
    "omnidirectional": OmnidirectionalLens(
        width=1350,
        height=1080,
        cx=678.544839263292 + 0.5,
        cy=542.975887548343 + 0.5,
        a0=769.243600037458,
        a2=-0.000812770624150226,
        a3=6.25674244578925e-07,
        a4=-1.19662182144280e-09,
        c=0.999986882249990,
        d=0.00288273829525059,
        e=-0.00296316513429569,
    ),
    "legacy-pinhole": BrownLens(
        width=1350, height=1080, fx=802.319, fy=801.885, cx=668.286 + 0.5, cy=547.733 + 0.5, k1=-0.42234, k2=0.10654
    ),
    "fisheye": FisheyeLens(
        width=1350,
        height=1080,
        fx=767.3861511125845,
        fy=767.5058656118406,
        cx=679.054265997005 + 0.5,
        cy=543.646891684636 + 0.5,
        k1=-0.18867185058223412,
        k2=-0.003927337093919806,
        k3=0.030524814153620117,
        k4=-0.012756926010904904,
    ),
}
"""C3VD's calibrations by name, at 1350 x 1080."""

#: How much of its width and height each corner of the frame loses: 202.5 of 1350 and 252 of 1080 pixels. Measured on
#: C3VD's published mask, which this reproduces but for pixels on the oblique edges themselves.
CORNER_CUT = (0.15, 7.0 / 30.0)


def octagon_mask(width: int, height: int) -> Bool[np.ndarray, "H W"]:
    """The part of a raw C3VD frame that the colonoscope fills: True inside the octagon. [H, W]"""
    x = (np.arange(width) + 0.5) / width
    y = (np.arange(height) + 0.5) / height
    across = np.minimum(x, 1.0 - x) / CORNER_CUT[0]
    down = np.minimum(y, 1.0 - y) / CORNER_CUT[1]
    inside: NDArray[np.bool_] = across[None, :] + down[:, None] >= 1.0
    return inside


def undistortion_map(lens: Lens, pinhole: Intrinsics) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Where ``cv2.remap`` finds each pixel of a pinhole image in the distorted image: its columns and rows.

    Unlike elsewhere, pixel centres are at INTEGERS, as OpenCV counts. Places may lie outside the distorted image, and
    are :data:`NOWHERE` where the lens does not reach.
    """
    k = pinhole
    x, y = np.meshgrid((np.arange(k.width) + 0.5 - k.cx) / k.fx, (np.arange(k.height) + 0.5 - k.cy) / k.fy)
    pixels = lens.project(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)) - 0.5
    pixels = np.where(np.isnan(pixels), NOWHERE, pixels).astype(np.float32)
    return pixels[:, 0].reshape(k.height, k.width), pixels[:, 1].reshape(k.height, k.width)


def along(direction: Array, length: Array, new_length: Array, ratio_at_zero: float) -> Array:
    """Vectors of new lengths along ``direction``, whose lengths are ``length``; smooth through zero. [N, 2]"""
    near = length < 1e-12
    ratio = np.where(near, ratio_at_zero, new_length / np.where(near, 1.0, length))
    return direction * ratio[:, None]


def _first_root(coefficients: list[float]) -> float:
    """The smallest positive real root of a polynomial, constant term first; infinite where there is none."""
    kept = np.polynomial.polyutils.trimcoef(coefficients, _NEGLIGIBLE)
    roots = np.polynomial.Polynomial(kept).roots()
    positive = roots.real[(np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots.real))) & (roots.real > 0.0)]
    return float(positive.min(initial=np.inf))


def _solve_increasing(
    function: Callable[[Array], Array], slope: Callable[[Array], Array], upper: Array, iterations: int = 60
) -> Array:
    """Roots in [0, upper] of increasing functions, one each, by Newton's method kept inside a bracket; NaN stays."""
    low, high = np.zeros_like(upper), upper.copy()
    root = 0.5 * upper
    for _ in range(iterations):
        value = function(root)
        low, high = np.where(value < 0.0, root, low), np.where(value >= 0.0, root, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = root - value / slope(root)
        following = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        moved = np.abs(following - root)
        root = following
        if not np.any(moved > 1e-14 * (1.0 + upper)):
            break
    return root


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
        step = _longest_step(self._columns, self._rows)
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


def _longest_step(columns: np.ndarray, rows: np.ndarray) -> float:
    """Source pixels per result pixel where the map is coarsest, leaving out the rim it does not reach."""
    steps = [np.hypot(np.diff(columns, axis=axis), np.diff(rows, axis=axis)).ravel() for axis in (0, 1)]
    return float(np.quantile(np.concatenate(steps), 0.95)) if columns.size > 1 else 1.0
