"""Lenses known by their forward map alone: against OpenCV, and against the lenses whose turning point has a form."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.datamanagers.colmap import ColmapLens
from coliags_plugin.geometry.lenses.models import LENSES, BrownLens
from coliags_plugin.geometry.lenses.tabulated import OpenCVLens

SIZE = {"width": 1350, "height": 1080}
VIEW = {"fx": 802.3, "fy": 790.1, "cx": 668.3, "cy": 547.7}
FULL = {"k1": -0.42, "k2": 0.1, "p1": 1e-3, "p2": -2e-3, "k3": 0.01, "k4": 0.02, "k5": 0.03, "k6": -0.01}
LENS = OpenCVLens(**SIZE, **VIEW, **FULL)
MATRIX = LENS.pinhole.opencv_matrix()
#: As cv2 orders them.
BENDS = np.array(list(FULL.values()))


def grid(step: int) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(-300, 1650, step), np.arange(-300, 1380, step))
    return np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)


def test_projecting_is_cv2s():
    points = np.random.default_rng(0).uniform([-40, -30, 20], [40, 30, 60], (500, 3))
    reference, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, BENDS)
    np.testing.assert_allclose(LENS.project(points), reference[:, 0] + 0.5, rtol=0, atol=1e-9)


def test_unprojecting_is_cv2s():
    pixels = grid(17)[np.linalg.norm(grid(17) - (668.3, 547.7), axis=1) < 600]
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 300, 1e-14)
    if hasattr(cv2, "undistortPointsIter"):  # until OpenCV 5
        reference = cv2.undistortPointsIter(pixels[:, None], MATRIX, BENDS, None, None, criteria)[:, 0]
    else:
        reference = cv2.undistortPoints(pixels[:, None], MATRIX, BENDS, criteria=criteria)[:, 0]
    np.testing.assert_allclose(LENS.unproject(pixels + 0.5)[:, :2], reference, rtol=0, atol=1e-8)


@pytest.mark.thorough
@settings(max_examples=30, deadline=None)
@given(x=st.floats(-0.9, 0.9), y=st.floats(-0.9, 0.9), z=st.floats(0.01, 200.0), width=st.sampled_from([1350, 338]))
def test_projecting_and_unprojecting_are_inverse(x, y, z, width):
    lens = LENS.resized(width, 270).cropped(7, -3, width - 20, 200)
    (direction,) = lens.unproject(lens.project([[x * z, y * z, z]]))
    np.testing.assert_allclose(direction, [x, y, 1.0], rtol=0, atol=1e-8)


def test_without_distortion_it_is_a_pinhole():
    lens = OpenCVLens(**SIZE, **VIEW)
    points = np.random.default_rng(0).uniform([-90, -90, 1], [90, 90, 60], (300, 3))
    plain = points[:, :2] / points[:, 2:] * (VIEW["fx"], VIEW["fy"]) + (VIEW["cx"], VIEW["cy"])
    np.testing.assert_allclose(lens.project(points), plain, rtol=1e-12)
    # At 89 degrees a pixel is no larger than the last digits of its number.
    np.testing.assert_allclose(lens.unproject(plain)[:, :2], points[:, :2] / points[:, 2:], rtol=1e-6, atol=1e-9)
    assert lens.pinhole == Intrinsics(**VIEW, **SIZE)


@pytest.mark.parametrize(
    "bends", [(-0.3, 0.0), (-0.42234, 0.10654), (-0.2, -0.1), (0.1, -0.05), (0.2, 0.1)], ids=lambda pair: f"{pair}"
)
def test_where_a_polynomial_turns_back_there_is_nothing(bends):
    closed = BrownLens(**SIZE, **VIEW, k1=bends[0], k2=bends[1])
    found = OpenCVLens(**SIZE, **VIEW, k1=bends[0], k2=bends[1])
    pixels = grid(17)
    expected, got = closed.unproject(pixels), found.unproject(pixels)
    np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
    # Next to the fold a pixel says little about its direction.
    inner = np.abs(np.nan_to_num(expected[:, 0])) < 0.95 * min(closed._turning_point, 5.0)
    np.testing.assert_allclose(got[inner], expected[inner], rtol=0, atol=1e-7)
    edge = min(closed._turning_point, np.tan(np.radians(89.8)))
    around = np.linspace(0.0, 2.0 * np.pi, 50)
    for share, reached in ((0.9999, True), (1.0001, np.isinf(closed._turning_point))):
        rim = edge * share * np.stack([np.cos(around), np.sin(around), np.full(50, 1.0 / (edge * share))], axis=1)
        assert np.isfinite(found.project(rim)).all() == reached


def test_a_fisheye_is_followed_up_to_its_own_turning_point():
    closed = LENSES["fisheye"]
    params = (closed.fx, closed.fy, closed.cx, closed.cy, closed.k1, closed.k2, closed.k3, closed.k4)
    found = ColmapLens(width=1350, height=1080, model="OPENCV_FISHEYE", params=params)
    pixels = grid(17)
    expected, got = closed.unproject(pixels), found.unproject(pixels)
    np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
    assert np.nanmax(np.abs(np.arctan(got[:, :2]) - np.arctan(expected[:, :2]))) < 1e-6
    assert np.isnan(found.project([[np.tan(np.radians(80)), 0, 1]])).all()
    assert np.isfinite(found.project([[np.tan(np.radians(75)), 0, 1]])).all()


def test_a_pole_of_the_rational_model_is_not_crossed():
    lens = OpenCVLens(**SIZE, **VIEW, k4=-0.5)
    assert np.isfinite(lens.project([[1.40, 0, 1]])).all()
    assert np.isnan(lens.project([[1.42, 0, 1], [3.0, 0, 1]])).all()


def test_what_cannot_be_seen_is_nan():
    assert np.isnan(LENS.project([[0, 0, -1], [1, 1, 0], [np.nan, 0, 1]])).all()
    assert np.isnan(LENS.unproject([[np.nan, 3.0], [1e9, 0.0]])).all()
    assert LENS.unproject(np.empty((0, 2))).shape == (0, 3)
    assert LENS.project(np.empty((0, 3))).shape == (0, 2)
