"""Paired tests against scipy and statsmodels, and their properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from statsmodels.stats.multitest import multipletests

from coliags_plugin.results.paired import (
    cohen_dz,
    holm,
    rank_biserial,
    smallest_p,
    t_interval,
    t_test_p,
    wilcoxon_p,
)

probabilities = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=9)
#: Multiples of 1/8, so that ties, zeros and their negatives are exact.
differences = st.lists(st.integers(-40, 40).map(lambda k: k / 8), min_size=2, max_size=8).map(np.array)


@pytest.mark.parametrize("p_values", [[0.01], [0.04, 0.01, 0.01, 0.9], [0.3, 0.02, 0.0, 1.0, 0.011, 0.02]])
def test_holm_is_that_of_statsmodels(p_values):
    assert holm(p_values) == pytest.approx(multipletests(p_values, method="holm")[1].tolist())


@given(probabilities)
def test_holm_keeps_the_order_and_never_lowers(p_values):
    adjusted = holm(p_values)
    assert all(p <= q <= 1.0 for p, q in zip(p_values, adjusted, strict=True))
    order = np.argsort(p_values, kind="stable")
    assert np.all(np.diff(np.array(adjusted)[order]) >= 0)
    assert min(adjusted) == pytest.approx(min(1.0, len(p_values) * min(p_values)))


@given(probabilities, st.data())
def test_holm_does_not_depend_on_the_order(p_values, data):
    order = data.draw(st.permutations(range(len(p_values))))
    assert holm([p_values[index] for index in order]) == [holm(p_values)[index] for index in order]


@pytest.mark.parametrize(
    ("scenes", "p"), [(1, 1.0), (3, 0.25), (5, 0.0625), (6, 0.03125), (7, 0.015625), (8, 0.0078125)]
)
def test_smallest_p_is_reached_where_one_method_always_wins(scenes, p):
    assert smallest_p(scenes) == p
    assert wilcoxon_p(np.arange(1.0, scenes + 1)) == pytest.approx(p)


@pytest.mark.parametrize("size", [6, 8, 10])
def test_wilcoxon_counts_sign_changes(size):
    """The exact p, by enumeration of all of them."""
    sample = np.random.default_rng(size).normal(0.3, 1.0, size)
    signs = np.array(np.meshgrid(*[[1.0, -1.0]] * size)).reshape(size, -1)
    ranks = stats.rankdata(np.abs(sample))
    exact = np.mean(np.abs(ranks @ signs) >= abs((np.sign(sample) * ranks).sum()) - 1e-9)
    assert wilcoxon_p(sample) == pytest.approx(exact)
    assert wilcoxon_p(np.append(sample, 0.0)) == pytest.approx(exact), "zeros are dropped"


def test_t_test_is_scipys():
    one, other = np.random.default_rng(3).normal(size=(2, 8))
    assert t_test_p(one - other) == pytest.approx(stats.ttest_rel(one, other).pvalue)


@settings(deadline=None, max_examples=25)
@given(differences, st.sampled_from([0.125, 0.5, 3.0, 1024.0]))
def test_swap_and_scale(sample, factor):
    """Swapping the methods flips effects and keeps p; another unit keeps both."""
    for test in (wilcoxon_p, t_test_p):
        p = test(sample)
        assert test(-sample) == (None if p is None else pytest.approx(p))
        assert test(factor * sample) == (None if p is None else pytest.approx(p))
    for effect in (cohen_dz, rank_biserial):
        size = effect(sample)
        assert effect(-sample) == (None if size is None else pytest.approx(-size))
        assert effect(factor * sample) == (None if size is None else pytest.approx(size))
    low, high = t_interval(sample)
    assert t_interval(-sample) == pytest.approx((-high, -low))
    assert t_interval(factor * sample) == pytest.approx((factor * low, factor * high))


@pytest.mark.parametrize("value", [0.0, 0.1, -3.7])
def test_equal_differences_have_no_t_and_no_d(value):
    sample = np.full(7, value)
    assert t_test_p(sample) is None
    assert cohen_dz(sample) is None
    assert t_interval(sample) == pytest.approx((value, value))


def test_effect_sizes_by_hand():
    sample = np.array([1.0, 2.0, 3.0, -4.0])
    assert cohen_dz(sample) == pytest.approx(0.5 / np.sqrt(29 / 3))
    assert rank_biserial(sample) == pytest.approx((1 + 2 + 3 - 4) / 10)
    assert rank_biserial(np.zeros(3)) == 0.0
    assert rank_biserial(np.array([0.0, 1.0, 2.0])) == 1.0


@pytest.mark.thorough  # statsmodels collects garbage in every call, half a second among the objects of a whole suite
@settings(deadline=None, max_examples=20)
@given(probabilities, st.integers(0, 4))
def test_holm_counts_those_of_the_family_that_are_not_there_as_one(p_values, more):
    expected = multipletests([*p_values, *[1.0] * more], method="holm")[1][: len(p_values)]
    assert holm(p_values, len(p_values) + more) == pytest.approx(expected.tolist())


def test_the_t_interval_is_scipys():
    sample = np.random.default_rng(5).gamma(2.0, size=8)
    reference = stats.ttest_1samp(sample, 0.0).confidence_interval(0.95)
    assert t_interval(sample) == pytest.approx((reference.low, reference.high))


@settings(deadline=None, max_examples=25)
@given(differences)
def test_the_t_interval_excludes_zero_where_the_t_test_says_so(sample):
    p = t_test_p(sample)
    if p is not None and abs(p - 0.05) > 1e-9:
        low, high = t_interval(sample)
        assert (low <= 0.0 <= high) == (p > 0.05)


def test_the_t_interval_of_eight_normal_leads_covers():
    """The percentile bootstrap contains the true mean in 90 % of cases."""
    samples = np.random.default_rng(7).normal(size=(4000, 8))
    inside = sum(low <= 0.0 <= high for low, high in map(t_interval, samples))
    assert 0.94 <= inside / len(samples) <= 0.96
