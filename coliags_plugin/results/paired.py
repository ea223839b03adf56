"""Paired tests, effect sizes and t interval of differences over scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

#: Scenes from which on a test is run: with 5, the two-sided Wilcoxon test cannot give less than .0625.
FEWEST_SCENES = 6

Differences = Float[np.ndarray, "n"]


def smallest_p(scenes: int) -> float:
    """The smallest p that the two-sided Wilcoxon test of ``scenes`` differences can give: 2 / 2^n."""
    return min(1.0, 2.0 * 0.5**scenes)


def wilcoxon_p(differences: Differences) -> float:
    """Two-sided p of the Wilcoxon signed-rank test by scipy, without the zeros.

    Exact for up to 50 differences without ties, else the normal approximation; never below :func:`smallest_p`. Without
    a difference that is not zero it is 1.
    """
    kept = differences[differences != 0.0]
    return max(float(stats.wilcoxon(kept).pvalue), smallest_p(len(kept))) if kept.size else 1.0


def t_test_p(differences: Differences) -> float | None:
    """Two-sided p of the paired t-test of two differences or more; undefined, None, where all are equal."""
    if _constant(differences):
        return None
    return float(stats.ttest_1samp(differences, 0.0).pvalue)


def cohen_dz(differences: Differences) -> float | None:
    """Cohen's d of paired samples: mean over standard deviation (n - 1); None where all differences are equal."""
    if _constant(differences):
        return None
    return float(np.mean(differences) / np.std(differences, ddof=1))


def rank_biserial(differences: Differences) -> float:
    """Matched-pairs rank-biserial correlation: (R+ - R-) / (R+ + R-), of the ranks of the non-zero differences.

    1 where all differences are positive, -1 where all are negative, 0 where none is other than zero. Source: Kerby,
    The simple difference formula, 2014.
    """
    kept = differences[differences != 0.0]
    if not kept.size:
        return 0.0
    ranks = stats.rankdata(np.abs(kept))
    return float(np.sum(np.sign(kept) * ranks) / np.sum(ranks))


def t_interval(differences: Differences, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of the mean of two differences or more by Student's t; the mean alone where all are equal.

    Where scenes are few, it covers more than bootstraps do (docs/reports.md 4).
    """
    mean, count = float(np.mean(differences)), len(differences)
    if _constant(differences):
        return mean, mean
    error = np.std(differences, ddof=1) / np.sqrt(count)
    reach = float(stats.t.ppf(0.5 + 0.5 * confidence, count - 1) * error)
    return mean - reach, mean + reach


def holm(p_values: Sequence[float], family: int | None = None) -> list[float]:
    """p-values adjusted by Holm's step-down procedure, in the given order.

    They are adjusted for the size of their family, by default their number; those that are not there count as 1.

    Source: Holm, A simple sequentially rejective multiple test procedure, 1979.
    """
    count = len(p_values) if family is None else family
    adjusted = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda index: p_values[index])):
        largest = max(largest, min(1.0, (count - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def _constant(differences: Differences) -> bool:
    """Whether all differences are equal up to rounding, so that their standard deviation is none."""
    size = float(np.max(np.abs(differences), initial=0.0))
    return float(np.ptp(differences)) <= 1e-12 * size
