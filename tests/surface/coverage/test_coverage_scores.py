"""Measures against the truth, on a row of unit squares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
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
    assert scores.region_recall == 0.5
    assert scores.recall == pytest.approx(3 / 6)
    assert scores.precision == pytest.approx(3 / 5)
    assert scores.false_positive_rate == pytest.approx(2 / 14)
    assert scores.false_omission_rate == pytest.approx(3 / 15)
    assert (scores.true_regions, scores.predicted_regions) == (2, 1)


def test_a_region_that_joins_two_is_no_false_positive_on_the_other():
    true, called = row((2, 6), (10, 14)), row((2, 14))
    scores = score_unseen(called, true, np.ones(N), CHAIN, 0.5)
    assert scores.mean_region_iou == pytest.approx(4 / 8)


def test_small_regions_count_only_as_surface():
    true, called = row((2, 6), (10, 11)), row((2, 6), (15, 16))
    scores = score_unseen(called, true, np.ones(N), CHAIN, 1.5)
    assert (scores.true_regions, scores.predicted_regions, scores.region_iou, scores.region_recall) == (1, 1, 1.0, 1.0)
    assert scores.face_iou == pytest.approx(4 / 6)


def test_nothing_to_find_has_no_score():
    scores = score_unseen(row(), row(), np.ones(N), CHAIN, 0.5)
    assert scores.face_iou is None and scores.recall is None and scores.region_recall is None
    assert scores.precision is None
    assert scores.false_positive_rate == scores.false_omission_rate == 0.0


@settings(deadline=None)
@given(true=flags, called=flags)
def test_properties(true, called):
    areas = np.linspace(0.5, 2.0, N)
    scores = score_unseen(called, true, areas, CHAIN, 0.1)
    perfect = score_unseen(true, true, areas, CHAIN, 0.1)
    everything = score_unseen(np.ones(N, bool), true, areas, CHAIN, 0.1)
    for value in (*scores.main_scores.values(), scores.false_omission_rate):
        assert value is None or 0.0 <= value <= 1.0
    if true.any():
        assert (perfect.face_iou, perfect.region_iou, perfect.region_recall) == (1.0, 1.0, 1.0)
        assert (perfect.recall, perfect.precision, perfect.false_omission_rate) == (
            1.0,
            1.0,
            None if true.all() else 0.0,
        )
        assert everything.region_recall == everything.recall == 1.0
        assert everything.precision == pytest.approx(areas[true].sum() / areas.sum())
        assert perfect.false_positive_rate == (None if true.all() else 0.0)
        assert everything.false_positive_rate == (None if true.all() else 1.0)
    if true.any() and called.any() and (true & called).any():
        false_positive, false_negative = areas[called & ~true].sum(), areas[~called & true].sum()
        true_positive = areas[called & true].sum()
        assert scores.precision == pytest.approx(true_positive / (true_positive + false_positive))
        assert scores.recall == pytest.approx(true_positive / (true_positive + false_negative))


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
