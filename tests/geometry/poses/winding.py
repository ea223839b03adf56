"""Trajectories to test with: cameras that wind about, no two axes alike."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.geometry.poses.trajectory import Trajectory, rigid

PINHOLE = Intrinsics(61.0, 55.0, 33.5, 21.5, 64, 48)


def winding(count: int = 12, seed: int = 0, extent: float = 30.0, **options) -> Trajectory:
    """Random rotations along a random walk."""
    rng = np.random.default_rng(seed)
    centers = np.cumsum(rng.normal(0.0, extent / max(count, 2), (count, 3)), axis=0) + rng.normal(0.0, 50.0, 3)
    return Trajectory(rigid(Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix(), centers), **options)


def some_transform(seed: int, extent: float = 40.0) -> np.ndarray:
    """A random rigid transform. [4, 4]"""
    return winding(1, seed, extent).camera_to_world[0]


def trajectories(**options) -> st.SearchStrategy[Trajectory]:
    """Trajectories of 3 to 12 poses."""
    return st.builds(
        lambda count, seed, extent: winding(count, seed, extent, **options),
        st.integers(3, 12),
        st.integers(0, 2**32 - 1),
        st.sampled_from([0.5, 30.0, 2000.0]),
    )


def as_text(rows, separator=" ", end="\n") -> str:
    """Rows of numbers as a file holds them, nothing rounded."""
    return end.join(separator.join(repr(float(number)) for number in row) for row in rows) + end
