"""Neighbours by baseline: a video may pause."""

from __future__ import annotations

import numpy as np

from coliags_plugin.reconstruction.depth.estimate import choose_neighbours
from coliags_plugin.reconstruction.depth.settings import DepthEstimationSettings

SETTINGS = DepthEstimationSettings(max_baseline=0.5)


def along(distances):
    centers = np.zeros((len(distances), 3))
    centers[:, 0] = distances
    return centers


def chosen(distances, depth=10.0, settings=SETTINGS, axes=None):
    ahead = np.tile([0.0, 0.0, 1.0], (len(distances), 1))
    directions = ahead if axes is None else axes
    return choose_neighbours(along(distances), directions, [depth] * len(distances), (0.1, 0.2), settings)


def test_the_first_frame_beyond_each_baseline_on_either_side():
    # A baseline of 0.1 at depth 10 is 1.
    assert chosen([0.5 * k for k in range(12)])[6] == [2, 4, 8, 10]


def test_a_pause_changes_no_distance():
    moving = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    paused = moving[:3] + [3.0] * 50 + moving[4:]
    for index in (3, 30, 52):
        assert [paused[other] for other in chosen(paused)[index]] == [1.0, 2.0, 4.0, 5.0]


def test_at_an_end_the_other_side_gives_more():
    first = chosen([1.0 * k for k in range(8)])[0]
    assert first == [1, 2, 4]  # 0.1 and 0.2, then 0.3, which is frame 4 by rounding, and 0.4
    assert len(chosen([0.5 * k for k in range(20)])[0]) == 4


def test_no_motion_gives_none():
    assert chosen([0.0] * 5) == [[]] * 5
    assert chosen([0.0, 0.2, 0.4]) == [[]] * 3


def test_neither_too_far_nor_turned_away():
    assert chosen([0.0, 9.0, 18.0]) == [[]] * 3
    axes = np.tile([0.0, 0.0, 1.0], (5, 1))
    axes[3] = [1.0, 0.0, 0.0]
    assert 3 not in chosen([1.0 * k for k in range(5)], axes=axes)[1]
