"""Lenses of which only one direction of the model is at hand, from viewing directions to pixels; OpenCV's full one."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import cKDTree

from coliags_plugin.geometry.lenses.models import Array, CalibratedLens, along

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
        asked = np.flatnonzero(np.isfinite(pixels).all(axis=1))
        tree, seeds = self._seeds
        if not len(asked) or not len(seeds):
            return tangents
        target = pixels[asked]
        angles = seeds[tree.query(target)[1]]
        going = np.arange(len(asked))
        for _ in range(30):
            miss = self._at(angles[going]) - target[going]
            off = np.linalg.norm(miss, axis=1) > 0.01 * _TOLERANCE
            going, miss = going[off], miss[off]
            if not len(going):
                break
            before = angles[going]
            angles[going] = self._kept_inside(before - _solved(self._jacobian(before), miss))
            # What no direction shows ends at the rim and stays there.
            going = going[np.abs(angles[going] - before).max(axis=1) > 1e-15]
        found = np.linalg.norm(self._at(angles) - target, axis=1) < _TOLERANCE
        tangents[asked[found]] = _directions(angles[found])
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

    def _kept_inside(self, angles: Array) -> Array:
        length, reach = np.linalg.norm(angles, axis=1), self._reach(angles)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(angles * np.where(length > reach, reach / length, 1.0)[:, None])

    def _at(self, angles: Array) -> Array:
        return self._bent(_directions(angles))

    def _keeps_orientation(self, clock: Array, angle: Array) -> Array:
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


@lru_cache(maxsize=64)
def _limits(lens: MappedLens) -> Array:
    """Angle up to which a lens's map may be used, radians, for directions at even steps round the axis. [AROUND]

    Cached by the lens's parameters: each time a scene is read, its lenses are made anew.
    """
    away: Array = np.linspace(0.0, _WIDEST, _AWAY + 1)[1:]
    grid = np.repeat(_CLOCK, _AWAY), np.tile(away, _AROUND)
    sound = lens._keeps_orientation(*grid).reshape(_AROUND, _AWAY)
    first_bad = np.where(sound.all(axis=1), _AWAY, np.argmin(sound, axis=1))
    high = away[np.minimum(first_bad, _AWAY - 1)]
    low = np.where(first_bad > 0, away[np.maximum(first_bad, 1) - 1], 0.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        sound_there = lens._keeps_orientation(_CLOCK, middle)
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
