"""Measures against the truth, on a row of unit squares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.surface.coverage.evaluation import score_unseen
from coliags_plugin.surface.coverage.measure import connected, large_regions, near_pairs, neighbours
from tests.surface.coverage.tubes import plane

N = 20
CHAIN = np.stack([np.arange(N - 1), np.arange(1, N)], axis=1)
flags = st.lists(st.booleans(), min_size=N, max_size=N).map(np.array)


def row(*spans):
    chosen = np.zeros(N, bool)
    for start, end in spans:
        chosen[start:end] = True
    return chosen


def test_scores_by_hand():
    true, called = row((2, 6), (10, 12)), row((3, 8))
    scores = score_unseen(called, true, np.ones(N), CHAIN, 0.5)
    assert scores.face_iou == pytest.approx(3 / 8)
    assert scores.region_iou == pytest.approx((4 * 3 / 6 + 2 * 0) / 6)
    assert scores.mean_region_iou == pytest.approx((3 / 6 + 0) / 2)
    assert scores.recall == 0.5
    assert scores.false_reassurance == pytest.approx(3 / 6)
    assert scores.false_alarm == pytest.approx(2 / 5)
    assert scores.unseen_among_called_seen == pytest.approx(3 / 15)
    assert scores.called_unseen_among_seen == pytest.approx(2 / 14)
    assert (scores.true_regions, scores.predicted_regions) == (2, 1)


def test_a_region_that_joins_two_is_no_false_alarm_on_the_other():
    true, called = row((2, 6), (10, 14)), row((2, 14))
    scores = score_unseen(called, true, np.ones(N), CHAIN, 0.5)
    assert scores.mean_region_iou == pytest.approx(4 / 8)


def test_small_regions_count_only_as_surface():
    true, called = row((2, 6), (10, 11)), row((2, 6), (15, 16))
    scores = score_unseen(called, true, np.ones(N), CHAIN, 1.5)
    assert (scores.true_regions, scores.predicted_regions, scores.region_iou, scores.recall) == (1, 1, 1.0, 1.0)
    assert scores.face_iou == pytest.approx(4 / 6)


def test_nothing_to_find_has_no_score():
    scores = score_unseen(row(), row(), np.ones(N), CHAIN, 0.5)
    assert scores.face_iou is None and scores.recall is None and scores.false_alarm is None
    assert scores.unseen_among_called_seen == 0.0


@given(true=flags, called=flags)
def test_properties(true, called):
    areas = np.linspace(0.5, 2.0, N)
    scores = score_unseen(called, true, areas, CHAIN, 0.1)
    perfect = score_unseen(true, true, areas, CHAIN, 0.1)
    everything = score_unseen(np.ones(N, bool), true, areas, CHAIN, 0.1)
    for value in (scores.face_iou, scores.region_iou, scores.recall, scores.false_reassurance, scores.false_alarm):
        assert value is None or 0.0 <= value <= 1.0
    if true.any():
        assert (perfect.face_iou, perfect.region_iou, perfect.recall, perfect.false_reassurance) == (1.0, 1.0, 1.0, 0.0)
        assert everything.recall == 1.0 and everything.false_reassurance == 0.0
        assert everything.false_alarm == pytest.approx(areas[~true].sum() / areas.sum())


def test_surface_that_does_not_count_is_left_out():
    areas = np.ones(N)
    areas[10:] = 0.0
    assert score_unseen(row((2, 6), (10, 20)), row((2, 6)), areas, CHAIN, 0.5).face_iou == 1.0


def test_neighbours_share_edges_and_regions_are_what_is_connected():
    mesh = plane(0.0, 2.0, 1.0)
    pairs = neighbours(mesh)
    # 4 x 4 squares: a diagonal in each, and 2 * 4 * 3 inner edges.
    assert len(pairs) == 16 + 24
    left, right = mesh.centers[:, 0] < -1.0, mesh.centers[:, 0] > 1.0
    numbers = connected(left | right, pairs)
    assert set(numbers[left]) != set(numbers[right]) and set(numbers[~left & ~right]) == {-1}
    assert [len(region) for region in large_regions(left | right, pairs, mesh.areas, 3.9)] == [8, 8]
    assert large_regions(left, pairs, mesh.areas, 4.1) == []
    bridged = np.concatenate([pairs, near_pairs(mesh.centers, left, right, 3.0)])
    assert len(large_regions(left | right, bridged, mesh.areas, 0.0)) == 1
    assert len(near_pairs(mesh.centers, left, right, 0.5)) == 0
    assert len(near_pairs(mesh.centers, left, np.zeros(32, bool), 9.0)) == 0
