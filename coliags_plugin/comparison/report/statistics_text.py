"""What the statistics of a report can say, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.report.tables import counted
from coliags_plugin.results.comparisons import LEVELS, RivalComparison
from coliags_plugin.results.paired import FEWEST_SCENES, RESAMPLES, smallest_p

_SMALLEST_PRINTED = 1e-4

#: What the columns of a table of leads are.
EXPLANATION = (
    "Lead: by how much the reference is better, mean over the scenes that both methods have; seeds are averaged "
    f"first. 95 % interval: percentile bootstrap of the lead over scenes, {RESAMPLES:,} resamples. Smallest p: what "
    "the two-sided Wilcoxon signed-rank test of so many scenes can give. Holm: adjusted for the number of rivals. "
    "Cohen's d: of paired samples, the mean lead over its standard deviation. Rank-biserial: matched-pairs "
    "correlation, 1 where the reference is better on every scene."
)


def statistics_text(compared: Sequence[RivalComparison], reference: str, chosen: bool) -> list[str]:
    """Sentences on the unit, the number of scenes and the smallest possible p; or why no test is run.

    Args:
        compared: The reference with each rival, by one metric.
        reference: Its name.
        chosen: Whether it was chosen beforehand, not for being the best.
    """
    most = max((len(row.scenes) for row in compared), default=0)
    if not most:
        return []
    if most < FEWEST_SCENES:
        return [
            f"No test is run: {counted(most, 'scene')} cannot tell methods apart. The unit is the scene, not the "
            f"frame, and of {counted(most, 'difference')} the two-sided Wilcoxon test cannot give less than p = "
            f"{smallest_p_text(most)}; tests are run from {FEWEST_SCENES} scenes on "
            f"(p = {smallest_p_text(FEWEST_SCENES)})."
        ]
    rivals = sum(row.tests is not None for row in compared)
    smallest = min(1.0, rivals * smallest_p(most))
    text = [
        f"Paired over {counted(most, 'scene')}: the unit is the scene, not the frame. The smallest p that the "
        f"two-sided Wilcoxon signed-rank test can give is {smallest_p_text(most)}, or "
        f"{smallest_p_text(most, rivals)} after Holm's adjustment for {counted(rivals, 'rival')}."
    ]
    if smallest >= LEVELS[0]:
        needed = next(count for count in range(most, 100) if rivals * smallest_p(count) < LEVELS[0])
        text.append(f"No star is possible, as that is not below {p_text(LEVELS[0])}; it takes {needed} scenes.")
    if not chosen:
        text.append(
            f"{reference} is the reference because it came out best, so that the p-values are too small: choose one "
            "beforehand, with --reference."
        )
    return text


def p_text(p: float) -> str:
    """A p-value: two significant digits, without a leading zero; ``1`` and ``< .0001`` at the ends."""
    return "< .0001" if p < _SMALLEST_PRINTED else f"{p:.2g}".removeprefix("0")


def smallest_p_text(scenes: int, rivals: int = 1) -> str:
    """The smallest p that so many scenes can give, adjusted for so many rivals: three significant digits."""
    p = min(1.0, rivals * smallest_p(scenes))
    return "< .0001" if p < _SMALLEST_PRINTED else f"{p:.3g}".removeprefix("0")
