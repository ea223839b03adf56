"""Numbers that are finite in a file and useless in a computation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import PointCloud
from coliags_plugin.datamanagers.fusion import subsampled
from coliags_plugin.geometry.lenses.models import FisheyeLens, OpenCVLens
from coliags_plugin.geometry.poses.trajectory import Trajectory


@pytest.mark.parametrize("far", [1e7, 1e38, 1e308, np.inf, np.nan])
@pytest.mark.parametrize("axis", [0, 2])
def test_cameras_far_away_are_refused(far, axis):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, axis, 3] = far
    with pytest.raises(InputError, match=r"^pose 1: "):
        Trajectory(poses)


@pytest.mark.parametrize(
    "values",
    [
        (1e8, 100, 50, 50, 100, 100),
        (1e-9, 100, 50, 50, 100, 100),
        (100, 100, -1e30, 50, 100, 100),
        (100, 100, float("nan"), 50, 100, 100),
        (100, 100, 50, 50, 100_000, 100),
        (100, 100, 50, 50, 100, 0),
    ],
)
def test_intrinsics_out_of_bounds_are_refused(values):
    with pytest.raises(InputError, match=r"^intrinsics fx"):
        Intrinsics(*values)


@pytest.mark.parametrize("lens", [FisheyeLens, OpenCVLens])
@pytest.mark.parametrize(("term", "value"), [("k1", 1e5), ("k2", -1e300), ("k3", float("inf")), ("fx", 1e9)])
def test_lens_terms_out_of_bounds_are_refused(lens, term, value):
    terms = {"fx": 100.0, "fy": 100.0, "cx": 50.0, "cy": 40.0, **{f"k{number}": 0.0 for number in range(1, 5)}}
    assert lens(width=100, height=80, **terms).pinhole.width == 100
    with pytest.raises(InputError, match=f"^a lens with {term} "):
        lens(width=100, height=80, **{**terms, term: value})


def test_points_far_away_are_left_out(caplog):
    positions = torch.tensor([[0.0, 0, 1], [1e7, 0, 0], [0, float("inf"), 0], [0, 0, float("nan")], [1, 1, 1]])
    points = subsampled(PointCloud(positions), 10, np.random.default_rng(0), None)
    assert points.positions.tolist() == [[0, 0, 1], [1, 1, 1]]
    assert "3 of 5 points are not finite, or beyond 1e+06" in caplog.text
