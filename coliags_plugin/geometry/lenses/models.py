"""Lenses, between pixels of an image and viewing directions: a pinhole, OpenCV's, and those that C3VD is read through.

Everything here is float64 and counts pixel centres at integers + 0.5, as :class:`Intrinsics` does.
Directions are in camera axes: x right, y down, z forward.

Three calibrations of one colonoscope are in use for the same 1350 x 1080 frames (docs/layouts/c3vd.md 2).
``omnidirectional`` rendered the ground truth. Within 560 pixels of the centre ``fisheye`` is within 0.2 degrees of
it, and ``legacy-pinhole``, behind most published numbers, off by up to 3.4 degrees (2.3 of them along the radius).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from typing_extensions import Self

from coliags_plugin.core import bounds
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics

Array = NDArray[np.float64]

#: Largest magnitudes of the numbers of a lens that are not terms of its distortion.
_LIMITS = dict.fromkeys(("fx", "fy", "cx", "cy", "stretch"), bounds.PIXELS)
_LIMITS |= dict.fromkeys(("width", "height"), float(bounds.IMAGE_SIDE))
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
        """True for points in camera axes that fall into the image and, where there is a mask, on its pixels."""
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
        """The nominal pinhole camera."""
        return Intrinsics(**vars(self))

    def unproject(self, pixels: ArrayLike) -> Float[np.ndarray, "N 3"]:
        """Viewing directions of pixels, (column, row), with z = 1. [N, 3]"""
        pixels = np.asarray(pixels, np.float64)
        x, y = (pixels[:, 0] - self.cx) / self.fx, (pixels[:, 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=1)

    def project(self, points: ArrayLike) -> Float[np.ndarray, "N 2"]:
        """Pixels, (column, row), of points in camera axes. [N, 2]"""
        points = np.asarray(points, np.float64)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        return np.stack([self.fx * points[:, 0] / z + self.cx, self.fy * points[:, 1] / z + self.cy], axis=1)


@dataclass(frozen=True, kw_only=True)
class CalibratedLens(Lens):
    """A lens with distortion, seen through an image that may be a scaled copy of the calibrated one.

    The calibration itself is never rescaled: pixels are first carried back to the calibrated image, so that
    scaling is exact for every model.
    """

    width: int
    height: int
    stretch: tuple[float, float] = (1.0, 1.0)  # pixels of the calibrated image per pixel of this one, (x, y)

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite or absurdly large."""
        for each in fields(self):
            value, limit = getattr(self, each.name), _LIMITS.get(each.name, bounds.DISTORTION)
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, (int, float)) and not abs(number) <= limit:  # NaN is not
                    raise InputError(f"a lens with {each.name} {number:g}", f"at most {limit:g} in magnitude")

    def resized(self, width: int, height: int) -> Self:
        """The lens of the image resampled to another size."""
        x, y = self.width / width, self.height / height
        return replace(self, width=width, height=height, stretch=(self.stretch[0] * x, self.stretch[1] * y))

    def unproject(self, pixels: ArrayLike) -> Float[np.ndarray, "N 3"]:
        """Viewing directions of pixels, (column, row), with z = 1. [N, 3]"""
        calibrated = np.asarray(pixels, np.float64) * self.stretch
        xy = self._tangents(calibrated)
        return np.concatenate([xy, np.where(np.isnan(xy[:, :1]), np.nan, 1.0)], axis=1)

    def project(self, points: ArrayLike) -> Float[np.ndarray, "N 2"]:
        """Pixels, (column, row), of points in camera axes. [N, 2]"""
        points = np.asarray(points, np.float64)
        z = points[:, 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            tangents = np.where(z > 0.0, points[:, :2] / z, np.nan)
        return self._calibrated_pixels(tangents) / self.stretch

    @property
    def pinhole(self) -> Intrinsics:
        """The nominal pinhole camera."""
        fx, fy, cx, cy = self._calibrated_pinhole
        x, y = 1.0 / self.stretch[0], 1.0 / self.stretch[1]
        return Intrinsics(fx * x, fy * y, cx * x, cy * y, self.width, self.height)

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
        """The radius seen at 90 degrees, infinite where there is none."""
        terms = np.polynomial.polyutils.trimcoef([self.a0, 0.0, self.a2, self.a3, self.a4], _NEGLIGIBLE)
        roots = np.polynomial.Polynomial(terms).roots()
        positive = roots.real[(np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots.real))) & (roots.real > 0.0)]
        return float(positive.min(initial=np.inf))

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


#: Largest angle from the optical axis in the table, radians. A pinhole image never shows larger ones.
_WIDEST = np.deg2rad(89.9)
#: The grid of directions a lens is probed on: round the axis, and away from it.
_AROUND, _AWAY = 256, 256
_CLOCK: Array = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
#: Step of the differences that stand for derivatives, radians: a thousandth of a pixel at focal length 1000.
_STEP = 1e-6
#: How far from its pixel an inverted direction may fall, pixels of the calibrated image.
_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True)
class MappedLens(CalibratedLens):
    """A lens given as a map from directions to pixels; where it may be used, and its inverse, are found from that map.

    Distortion polynomials are fitted inside an image and turn back somewhere beyond it, where one pixel gets a second,
    meaningless direction. So from the optical axis outwards, in every direction, the map is followed as long as it
    keeps its orientation (its Jacobian's determinant stays positive); what lies beyond is NaN. Inside, the map is
    inverted by Newton's method, to 1e-6 pixels.

    Directions are worked with as vectors of their angle from the axis, ``angle * (cos, sin)``, in which wide and narrow
    lenses are equally well scaled.
    """

    @abstractmethod
    def _bent(self, tangents: Array) -> Array:
        """Pixels of the calibrated image of (x / z, y / z), anything where the model makes no sense. [N, 2]"""

    def _calibrated_pixels(self, tangents: Array) -> Array:
        angles = _angles(tangents)
        with np.errstate(invalid="ignore"):
            inside = np.linalg.norm(angles, axis=1) < self._reach(angles)
        pixels = np.full_like(tangents, np.nan)
        pixels[inside] = self._bent(tangents[inside])
        return pixels

    def _tangents(self, pixels: Array) -> Array:
        tangents = np.full_like(pixels, np.nan)
        finite_rows = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        tree, seeds = self._seeds
        if not len(finite_rows) or not len(seeds):
            return tangents
        target = pixels[finite_rows]
        angles = seeds[tree.query(target)[1]]
        going = np.arange(len(finite_rows))
        for _ in range(30):
            miss = self._at(angles[going]) - target[going]
            off = np.linalg.norm(miss, axis=1) > 1e-4 * _TOLERANCE
            going, miss = going[off], miss[off]
            if not len(going):
                break
            before = angles[going]
            after = before - _solved(self._jacobian(before), miss)
            length, reach = np.linalg.norm(after, axis=1), self._reach(after)
            with np.errstate(divide="ignore", invalid="ignore"):
                angles[going] = after * np.where(length > reach, reach / length, 1.0)[:, None]
            # What no direction shows ends at the rim and stays there.
            going = going[np.abs(angles[going] - before).max(axis=1) > 1e-15]
        is_reached = np.linalg.norm(self._at(angles) - target, axis=1) < _TOLERANCE
        tangents[finite_rows[is_reached]] = _directions(angles[is_reached])
        return tangents

    @cached_property
    def _seeds(self) -> tuple[cKDTree, Array]:
        """Pixels of a grid of usable directions, to be looked up, and those directions. [S, 2]"""
        clock = np.repeat(_CLOCK, _AWAY)
        # Sparser at wide angles, as far as each direction reaches, but not onto the fold itself.
        share = np.tile((np.arange(_AWAY) + 0.5) / _AWAY, _AROUND)
        angles = _vector(clock, share * np.repeat(_limits(self), _AWAY))
        pixels = self._at(angles)
        finite = np.isfinite(pixels).all(axis=1)
        return cKDTree(pixels[finite]), angles[finite]

    def _reach(self, angles: Array) -> Array:
        """The limit in the direction of each vector. [N]"""
        clock = np.arctan2(angles[:, 1], angles[:, 0])
        return np.interp(clock, _CLOCK, _limits(self), period=2.0 * np.pi)

    def _at(self, angles: Array) -> Array:
        return self._bent(_directions(angles))

    def keeps_orientation(self, clock: Array, angle: Array) -> Array:
        """Mask of directions at which the map from angles to the image does not mirror."""
        with np.errstate(all="ignore"):
            jacobian = self._jacobian(_vector(clock, angle))
            return np.asarray(np.linalg.det(jacobian) > 0.0)

    def _jacobian(self, angles: Array) -> Array:
        """Derivatives of the pixel, by central differences. [N, 2, 2]"""
        columns = [(self._at(angles + step) - self._at(angles - step)) / (2.0 * _STEP) for step in _STEP * np.eye(2)]
        return np.stack(columns, axis=2)


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


@dataclass(frozen=True, kw_only=True)
class FisheyeLens(MappedLens):
    """OpenCV's fisheye (Kannala-Brandt): the angle r from the axis becomes r (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8).

    fx, fy, cx and cy are pixels, centres at integers + 0.5.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float

    @property
    def _calibrated_pinhole(self) -> tuple[float, float, float, float]:
        return self.fx, self.fy, self.cx, self.cy

    def _bent(self, tangents: Array) -> Array:
        tangent = np.linalg.norm(tangents, axis=1)
        angle = np.arctan(tangent)
        square = angle**2
        bent = angle * (1.0 + square * (self.k1 + square * (self.k2 + square * (self.k3 + square * self.k4))))
        return along(tangents, tangent, bent, 1.0) * (self.fx, self.fy) + (self.cx, self.cy)


@lru_cache(maxsize=64)
def _limits(lens: MappedLens) -> Array:
    """Angle up to which a lens's map may be used, radians, for directions at even steps round the axis. [AROUND]

    Cached by the lens's parameters: each time a scene is read, its lenses are made anew.
    """
    away: Array = np.linspace(0.0, _WIDEST, _AWAY + 1)[1:]
    grid = np.repeat(_CLOCK, _AWAY), np.tile(away, _AROUND)
    sound = lens.keeps_orientation(*grid).reshape(_AROUND, _AWAY)
    first_bad = np.where(sound.all(axis=1), _AWAY, np.argmin(sound, axis=1))
    high = away[np.minimum(first_bad, _AWAY - 1)]
    low = np.where(first_bad > 0, away[np.maximum(first_bad, 1) - 1], 0.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        sound_there = lens.keeps_orientation(_CLOCK, middle)
        low, high = np.where(sound_there, middle, low), np.where(sound_there, high, middle)
    return np.where(first_bad == _AWAY, _WIDEST, low)


def _vector(clock: Array, angle: Array) -> Array:
    return np.stack([angle * np.cos(clock), angle * np.sin(clock)], axis=1)


def _angles(tangents: Array) -> Array:
    """Angle vectors of (x / z, y / z). [N, 2]"""
    length = np.linalg.norm(tangents, axis=1)
    return along(tangents, length, np.arctan(length), 1.0)


def _directions(angles: Array) -> Array:
    """Inverse of :func:`_angles`. [N, 2]"""
    length = np.linalg.norm(angles, axis=1)
    return along(angles, length, np.tan(length), 1.0)


def _solved(matrices: Array, values: Array) -> Array:
    """Solutions of 2 x 2 systems; 0 where a matrix is singular or not finite. [N, 2]"""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    determinant = a * d - b * c
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        x = (d * values[:, 0] - b * values[:, 1]) / determinant
        y = (a * values[:, 1] - c * values[:, 0]) / determinant
    solution = np.stack([x, y], axis=1)
    return np.where(np.isfinite(solution).all(axis=1, keepdims=True), solution, 0.0)


def along(direction: Array, length: Array, new_length: Array, ratio_at_zero: float) -> Array:
    """Vectors of new lengths along ``direction``, whose lengths are ``length``; smooth through zero. [N, 2]"""
    near = length < 1e-12
    ratio = np.where(near, ratio_at_zero, new_length / np.where(near, 1.0, length))
    return direction * ratio[:, None]


def _solve_increasing(function: Callable[[Array], Array], slope: Callable[[Array], Array], upper: Array) -> Array:
    """Roots in [0, upper] of increasing functions, one each, by Newton's method kept inside a bracket; NaN stays."""
    low, high = np.zeros_like(upper), upper.copy()
    root = 0.5 * upper
    for _ in range(60):
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
    "legacy-pinhole": OpenCVLens(
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
