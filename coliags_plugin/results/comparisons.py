"""Comparison of a reference method with each of its rivals over their common scenes: paired tests and effect sizes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import stats

#: Scenes from which on a test is run: with 5, the two-sided Wilcoxon test cannot give less than .0625.
FEWEST_SCENES = 6
#: Significance levels of one, two and three stars.
LEVELS = (0.05, 0.01, 0.001)
Differences = Float[np.ndarray, "n"]
#: A metric of one method: value by scene and seed.
BySeed = Mapping[str, Mapping[int, float]]


@dataclass(frozen=True)
class Spread:
    """Mean, median and spread of a method's metric.

    That over seeds is the root mean square, over the scenes with two seeds or more, of the standard deviation (n - 1)
    over the seeds of a scene; None where there is no such scene.
    """

    mean: float | None  # mean over scenes of the means over seeds; None without a scene
    over_scenes: float | None  # standard deviation (n - 1) of these means; None for a single scene
    over_seeds: float | None
    scenes: int
    median: float | None  # over the same means over seeds

    @property
    def ruled_by_few(self) -> bool:
        """Tell whether few scenes rule the mean: it is more than twice the median."""
        return self.mean is not None and self.median is not None and self.mean > 2.0 * self.median > 0.0


def scene_means(values: BySeed) -> dict[str, float]:
    """Mean over seeds of each scene that has a value."""
    return {scene: float(np.mean([*seeds.values()])) for scene, seeds in values.items() if seeds}


def spread(values: BySeed, scenes: Sequence[str]) -> Spread:
    """Mean, median and spread over scenes that all have a value."""
    means = [float(np.mean([*values[scene].values()])) for scene in scenes]
    variances = [np.var([*values[scene].values()], ddof=1) for scene in scenes if len(values[scene]) > 1]
    return Spread(
        mean=float(np.mean(means)) if means else None,
        over_scenes=float(np.std(means, ddof=1)) if len(means) > 1 else None,
        over_seeds=float(np.sqrt(np.mean(variances))) if variances else None,
        scenes=len(means),
        median=float(np.median(means)) if means else None,
    )


def common_scenes(methods: Sequence[Mapping[str, Collection[object]]]) -> list[str]:
    """Scenes for which every method has a value, in the order of the first method."""
    covered = [{scene for scene, seeds in values.items() if seeds} for values in methods]
    return [scene for scene in methods[0] if all(scene in scenes for scenes in covered)] if methods else []


@dataclass(frozen=True)
class PairedTests:
    """Tests and effect sizes of a lead; positive effects speak for the reference.

    Differences that are equal up to rounding have no standard deviation: no t-test, no Cohen's d, and the mean alone as
    the interval.
    """

    wilcoxon: float  # two-sided p of the Wilcoxon signed-rank test
    wilcoxon_holm: float  # the same, adjusted for the family of rivals
    t_test: float | None  # two-sided p of the paired t-test
    t_test_holm: float | None  # the same, adjusted for the family of rivals
    interval: tuple[float, float]  # 95 % t interval of the mean lead
    cohen_dz: float | None  # mean over standard deviation (n - 1)
    rank_biserial: float  # matched-pairs rank-biserial correlation

    @classmethod
    def of(cls, differences: Differences) -> PairedTests:
        """Tests of two differences or more as a family of their own.

        Where scenes are few, the t interval covers more than bootstraps do (docs/reports.md 4).
        """
        mean, wilcoxon = float(np.mean(differences)), wilcoxon_p(differences)
        t_test, cohen_dz, interval = None, None, (mean, mean)
        if float(np.ptp(differences)) > 1e-12 * float(np.max(np.abs(differences))):
            test = stats.ttest_1samp(differences, 0.0)
            low, high = test.confidence_interval(0.95)
            t_test, interval = float(test.pvalue), (float(low), float(high))
            cohen_dz = mean / float(np.std(differences, ddof=1))
        return cls(wilcoxon, wilcoxon, t_test, t_test, interval, cohen_dz, rank_biserial(differences))


@dataclass(frozen=True)
class RivalComparison:
    """Lead of a reference over a rival."""

    rival: str
    scenes: tuple[str, ...]  # scenes that both have
    lead: float | None  # mean over the scenes, positive where the reference is better; None without a common scene
    better_on: int  # number of scenes on which the reference is better
    tests: PairedTests | None  # None with fewer than six common scenes

    @property
    def stars(self) -> str:
        """One star for each level that the adjusted Wilcoxon p stays below, as far as so many scenes can give it."""
        if self.tests is None:
            return ""
        possible = [level for level in LEVELS if smallest_p(len(self.scenes)) < level]
        return "*" * sum(self.tests.wilcoxon_holm < level for level in possible)


def compare_with_rivals(
    values: Mapping[str, BySeed], reference: str, higher_is_better: bool, family: int = 0
) -> list[RivalComparison]:
    """Compare a reference with every other method, each pair on their common scenes, seeds averaged first.

    p-values are adjusted for the family: so many rivals, with or without values, and at least those that are here.
    """
    sign, means = 1.0 if higher_is_better else -1.0, {method: scene_means(each) for method, each in values.items()}
    leads = {
        rival: {
            scene: sign * (means[reference][scene] - by_scene[scene]) for scene in means[reference] if scene in by_scene
        }
        for rival, by_scene in means.items()
        if rival != reference
    }
    samples = {rival: [*each.values()] for rival, each in leads.items() if len(each) >= FEWEST_SCENES}
    tests = {rival: PairedTests.of(np.array(sample)) for rival, sample in samples.items()}
    wilcoxon = {rival: each.wilcoxon for rival, each in tests.items()}
    t_test = {rival: each.t_test for rival, each in tests.items() if each.t_test is not None}
    wilcoxon_holm, t_test_holm = (
        dict(zip(p_values, holm([*p_values.values()], max(family, len(leads))), strict=True))
        for p_values in (wilcoxon, t_test)
    )
    tests = {
        rival: replace(each, wilcoxon_holm=wilcoxon_holm[rival], t_test_holm=t_test_holm.get(rival))
        for rival, each in tests.items()
    }
    return [
        RivalComparison(
            rival=rival,
            scenes=tuple(each),
            lead=float(np.mean([*each.values()])) if each else None,
            better_on=sum(lead > 0.0 for lead in each.values()),
            tests=tests.get(rival),
        )
        for rival, each in leads.items()
    ]


def smallest_p(scenes: int) -> float:
    """The smallest p that the two-sided Wilcoxon test of ``scenes`` differences can give: 2 / 2^n."""
    return min(1.0, 2.0 * 0.5**scenes)


def wilcoxon_p(differences: Differences) -> float:
    """Two-sided p of the Wilcoxon signed-rank test by scipy, without the zeros.

    Exact for up to 50 differences without ties, else the normal approximation; never below :func:`smallest_p`. Without
    a difference that is not zero it is 1.
    """
    nonzero = differences[differences != 0.0]
    return max(float(stats.wilcoxon(nonzero).pvalue), smallest_p(len(nonzero))) if nonzero.size else 1.0


def rank_biserial(differences: Differences) -> float:
    """Matched-pairs rank-biserial correlation: (R+ - R-) / (R+ + R-), of the ranks of the non-zero differences.

    1 where all differences are positive, -1 where all are negative, 0 where none is other than zero. Source: Kerby,
    The simple difference formula, 2014.
    """
    nonzero = differences[differences != 0.0]
    ranks = stats.rankdata(np.abs(nonzero))
    return float(np.sum(np.sign(nonzero) * ranks) / np.sum(ranks)) if nonzero.size else 0.0


def holm(p_values: Sequence[float], family: int) -> list[float]:
    """p-values adjusted for the size of their family by Holm's step-down procedure, in the given order.

    Those of the family that are not there count as 1.

    Source: Holm, A simple sequentially rejective multiple test procedure, 1979.
    """
    order = np.argsort(p_values, kind="stable")
    stepped = np.minimum(1.0, (family - np.arange(len(p_values))) * np.array(p_values, dtype=np.float64)[order])
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.maximum.accumulate(stepped)
    return adjusted.tolist()
