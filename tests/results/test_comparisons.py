"""Comparison over scenes: pairing, seeds, families, what few scenes allow; tests against scipy and statsmodels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from statsmodels.stats.multitest import multipletests

from coliags_plugin.results.comparisons import (
    PairedTests,
    common_scenes,
    compare_with_rivals,
    holm,
    rank_biserial,
    scene_means,
    smallest_p,
    spread,
    wilcoxon_p,
)


def one_seed(values):
    """Values of scenes a, b, ... under seed 0; None leaves a scene out."""
    return {chr(97 + index): {0: value} for index, value in enumerate(values) if value is not None}


def test_spread_by_hand():
    values = {"a": {0: 1.0, 1: 3.0}, "b": {0: 5.0}, "c": {0: 7.0, 1: 7.0, 2: 13.0}}
    result = spread(values, ["a", "b", "c"])
    assert (result.mean, result.scenes) == (pytest.approx(16 / 3), 3)
    assert result.over_scenes == pytest.approx(np.std([2, 5, 9], ddof=1))
    assert result.over_seeds == pytest.approx(np.sqrt((2 + 12) / 2))
    assert (result.median, result.ruled_by_few) == (5.0, False)
    far = spread({"a": {0: 1.0}, "b": {0: 2.0}, "c": {0: 9.1}}, ["a", "b", "c"])
    assert (far.median, far.ruled_by_few) == (2.0, True)
    alone = spread(values, ["b"])
    assert (alone.mean, alone.over_scenes, alone.over_seeds) == (5.0, None, None)


def test_frames_and_seeds_do_not_count_as_scenes():
    """Ten seeds of one scene are one number."""
    values = {"x": {"a": dict.fromkeys(range(10), 2.0)}, "y": {"a": dict.fromkeys(range(10), 1.0)}}
    (row,) = compare_with_rivals(values, "x", True)
    assert (len(row.scenes), row.lead, row.tests, row.stars) == (1, 1.0, None, "")


def test_common_scenes_keep_the_order():
    assert common_scenes([one_seed([1, 2, 3]), {"c": {0: 1}, "a": {0: 1}, "b": {}}]) == ["a", "c"]
    assert scene_means({"a": {0: 1.0, 3: 2.0}, "b": {}}) == {"a": 1.5}
    assert common_scenes([]) == []


def test_a_comparison_is_the_references():
    rng = np.random.default_rng(1)
    ours = rng.normal(33.0, 2.0, 10)
    rivals = {"x": ours - rng.normal(1.0, 0.8, 10), "y": ours - rng.normal(0.4, 0.8, 10), "z": ours + 0.5}
    values = {"ours": one_seed(ours), **{name: one_seed(rival) for name, rival in rivals.items()}}
    rows = compare_with_rivals(values, "ours", higher_is_better=True)
    raw = [stats.wilcoxon(ours, rival).pvalue for rival in rivals.values()]
    holm = multipletests(raw, method="holm")[1]
    assert [row.rival for row in rows] == ["x", "y", "z"]
    assert [row.tests.wilcoxon for row in rows] == pytest.approx(raw)
    assert [row.tests.wilcoxon_holm for row in rows] == pytest.approx(holm.tolist())
    assert rows[0].tests.t_test == pytest.approx(stats.ttest_rel(ours, rivals["x"]).pvalue)
    assert rows[2].tests.t_test is None  # all differences are -0.5
    t_holm = multipletests([rows[0].tests.t_test, rows[1].tests.t_test, 1.0], method="holm")[1]
    assert [rows[0].tests.t_test_holm, rows[1].tests.t_test_holm] == pytest.approx(t_holm[:2].tolist())
    assert rows[2].lead == pytest.approx(-0.5)
    assert (rows[2].better_on, rows[2].tests.rank_biserial) == (0, -1.0)
    assert rows[0].tests.interval[0] < rows[0].lead < rows[0].tests.interval[1]


def test_every_pair_is_compared_on_its_own_scenes():
    values = {
        "ours": one_seed([9.0] * 8),
        "whole": one_seed([1.0] * 8),
        "part": one_seed([1.0, None, 3.0] + [1.0] * 5),
        "none": {"q": {0: 1.0}},
    }
    whole, part, none = compare_with_rivals(values, "ours", True)
    assert len(whole.scenes) == 8
    assert part.scenes == ("a", "c", "d", "e", "f", "g", "h")
    assert part.lead == pytest.approx(8 - 2 / 7)
    assert (none.scenes, none.lead, none.tests) == ((), None, None)


@pytest.mark.parametrize(
    ("scenes", "rivals", "stars"),
    [(5, 1, ""), (6, 1, "*"), (6, 2, ""), (8, 1, "**"), (8, 6, "*"), (8, 7, ""), (11, 1, "***"), (22, 6, "***")],
)
def test_stars_are_those_that_so_many_scenes_and_rivals_allow(scenes, rivals, stars):
    """The reference wins everywhere: nothing can be more significant."""
    leads = np.linspace(1.0, 2.0, scenes)
    values = {"ours": one_seed(leads), **{f"rival {index}": one_seed(0 * leads) for index in range(rivals)}}
    assert {row.stars for row in compare_with_rivals(values, "ours", True)} == {stars}


# Tests and effect sizes

#: Multiples of 1/8, so that ties, zeros and their negatives are exact.
differences = st.lists(st.integers(-40, 40).map(lambda k: k / 8), min_size=2, max_size=8).map(np.array)


@pytest.mark.parametrize("p_values", [[0.01], [0.04, 0.01, 0.01, 0.9], [0.3, 0.02, 0.0, 1.0, 0.011, 0.02]])
def test_holm_is_that_of_statsmodels(p_values):
    assert holm(p_values, len(p_values)) == pytest.approx(multipletests(p_values, method="holm")[1].tolist())


@pytest.mark.parametrize(
    ("scenes", "p"), [(1, 1.0), (3, 0.25), (5, 0.0625), (6, 0.03125), (7, 0.015625), (8, 0.0078125)]
)
def test_smallest_p_is_reached_where_one_method_always_wins(scenes, p):
    assert smallest_p(scenes) == p
    sample = np.arange(scenes + 1.0)
    assert wilcoxon_p(sample) == wilcoxon_p(-sample[1:]) == pytest.approx(p), "zeros are dropped"
    assert wilcoxon_p(np.ones(scenes)) >= p, "the normal approximation of six equal differences would give .014"


@settings(deadline=None, max_examples=25)
@given(differences, st.sampled_from([0.125, 0.5, 3.0, 1024.0]))
def test_swap_and_scale(sample, factor):
    """Swapping the methods flips effects and keeps p; another unit keeps both."""
    assert wilcoxon_p(-sample) == wilcoxon_p(factor * sample) == pytest.approx(wilcoxon_p(sample))
    assert rank_biserial(-sample) == pytest.approx(-rank_biserial(sample))
    assert rank_biserial(factor * sample) == pytest.approx(rank_biserial(sample))
    first, swapped, scaled = map(PairedTests.of, (sample, -sample, factor * sample))
    low, high = first.interval
    assert swapped.interval == pytest.approx((-high, -low))
    assert scaled.interval == pytest.approx((factor * low, factor * high))
    p, size = first.t_test, first.cohen_dz
    others = (swapped.t_test, swapped.cohen_dz, scaled.t_test, scaled.cohen_dz)
    assert others == ((None,) * 4 if p is None else pytest.approx((p, -size, p, size)))


def test_effect_sizes_and_the_interval_by_hand():
    sample = np.array([1.0, 2.0, 3.0, -4.0])
    reach = 3.182446 * np.sqrt(29 / 3 / 4)  # the .975 quantile of Student's t with 3 degrees of freedom
    assert PairedTests.of(sample).interval == pytest.approx((0.5 - reach, 0.5 + reach))
    assert PairedTests.of(sample).cohen_dz == pytest.approx(0.5 / np.sqrt(29 / 3))
    assert rank_biserial(sample) == pytest.approx((1 + 2 + 3 - 4) / 10)
    assert [rank_biserial(np.array(each)) for each in ([0.0] * 3, [0.0, 1.0, 2.0])] == [0.0, 1.0]
    for value in (0.0, 0.1, -3.7):
        equal = PairedTests.of(np.full(7, value))
        assert (equal.t_test, equal.cohen_dz, equal.interval) == (None, None, pytest.approx((value, value)))
