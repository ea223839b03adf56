"""A reference's lead over its rivals: tables of tests, intervals and effect sizes, and what they can say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import starmap

from coliags_plugin.comparison.report.metric_tables import metric_columns, metric_title, shared_scenes, spreads
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.reporting.model import Column, Table, TableCell
from coliags_plugin.reporting.numbers import column_decimals, counted, number_text, unit_text
from coliags_plugin.results.comparisons import (
    FEWEST_SCENES,
    LEVELS,
    PairedTests,
    RivalComparison,
    compare_with_rivals,
    smallest_p,
)

#: The reference where it is among the methods.
PREFERRED = "coliags"
#: What the columns of a table of leads are.
EXPLANATION = (
    "Lead: by how much the reference is better, mean over the scenes that both methods have; seeds are averaged "
    "first. 95 % t interval: of the mean lead over scenes, by Student's t. Smallest p: what the two-sided Wilcoxon "
    "signed-rank test of so many scenes can give. Holm: adjusted for all rivals that were planned or given. "
    "Cohen's d: of paired samples, the mean lead over its standard deviation. Rank-biserial: matched-pairs "
    "correlation, 1 where the reference is better on every scene."
)
_SMALLEST_PRINTED = 1e-4
_TESTS = {
    "smallest": "Smallest p",
    "wilcoxon": "Wilcoxon p",
    "wilcoxon_holm": "Holm",
    "t_test": "t-test p",
    "t_test_holm": "Holm",
    "cohen_dz": "Cohen's d",
    "rank_biserial": "Rank-biserial",
}


def choose_reference(study: Study, chosen: str | None) -> str:
    """The method that the others are compared with: that chosen, else that decided, else ``coliags``, else the best."""
    if chosen is None:
        if study.decided is not None and study.decided.reference in study.methods:
            return study.decided.reference
        return PREFERRED if PREFERRED in study.methods else _best_method(study.parts[0])
    if chosen not in study.methods:
        known = ", ".join(study.methods)
        raise InputError(
            f"--reference {chosen}: no such method", f"one of {known}", did_you_mean(chosen, study.methods)
        )
    return chosen


def _best_method(part: Part) -> str:
    """The method that is best by the first metric; the first one where none has a value."""
    column = metric_columns(part)[0]
    values = part.values(column.key)
    found = dict(zip(values, spreads(values, shared_scenes(values)), strict=True))
    means = {method: own.mean for method, own in found.items() if own.mean is not None}
    sign = 1.0 if column.direction == "higher" else -1.0
    return max(means, key=lambda method: sign * means[method]) if means else part.study.methods[0]


def compare(part: Part, column: Column, reference: str) -> list[RivalComparison]:
    """Paired comparisons of the reference with every method by one metric; empty where it has no value."""
    study, values = part.study, part.values(column.key)
    if column.direction is None or not values[reference]:
        return []
    rivals = {method: by_scene for method, by_scene in values.items() if by_scene}
    compared = compare_with_rivals(rivals, reference, column.direction == "higher", _family(study, reference))
    is_primary = study.decided is not None and is_decided(study, reference) and column.key in study.decided.primary
    return [replace(row, exploratory=not is_primary) for row in compared]


def _family(study: Study, reference: str) -> int:
    """Number of rivals that p-values are adjusted for: all methods that were planned or given."""
    return len({*study.family, *study.methods} - {reference})


def is_decided(study: Study, reference: str) -> bool:
    """Whether the reference is that which was decided before the first result."""
    return study.decided is not None and study.decided.reference == reference


def lead_table(part: Part, column: Column, compared: Sequence[RivalComparison], reference: str) -> Table:
    """Lead of the reference by one metric over each rival, with tests where there are enough scenes."""
    unit = unit_text(column.unit)
    columns = [
        Column("over", "Over", words=True),
        Column("scenes", "Scenes"),
        Column("lead", "Lead", column.unit),
        Column("better", "Better on"),
    ]
    if any(row.tests for row in compared):
        columns += [Column("interval", "95 % t interval", column.unit), *starmap(Column, _TESTS.items())]
    decimals = column_decimals(column.unit, [row.lead for row in compared])
    untested = dict.fromkeys(
        [each.key for each in columns[4:]], TableCell(note=f"fewer than {FEWEST_SCENES} scenes in common")
    )
    return Table(
        title=f"{column.title}: lead of {reference}",
        columns=columns,
        rows=[
            {
                "over": TableCell(row.rival, style=part.study.methods.index(row.rival)),
                "scenes": len(row.scenes),
                "lead": TableCell(note="no scene in common") if row.lead is None else _signed(row.lead, decimals),
                "better": TableCell(f"{row.better_on} of {len(row.scenes)}", row.better_on),
                **(untested if row.tests is None else _test_cells(row, row.tests, decimals)),
            }
            for row in compared
        ],
        notes=["Exploratory: no stars"] if all(row.exploratory for row in compared) else [],
        count=part.title + (f", {unit}" if unit else ""),
        name=f"lead-{part.name}-{column.key}",
    )


def _test_cells(row: RivalComparison, tests: PairedTests, decimals: int) -> dict[str, TableCell]:
    scenes = len(row.scenes)
    low, high = (_signed(end, decimals) for end in tests.interval)
    undefined = TableCell(note="all differences are equal")
    t_tests = {"t_test": tests.t_test, "t_test_holm": tests.t_test_holm}
    return {
        "interval": TableCell(f"{low.text} to {high.text}", low.value),
        "smallest": TableCell(smallest_p_text(scenes), smallest_p(scenes)),
        "wilcoxon": TableCell(p_text(tests.wilcoxon), tests.wilcoxon),
        "wilcoxon_holm": TableCell(p_text(tests.wilcoxon_holm), tests.wilcoxon_holm, stars=row.stars),
        **{name: undefined if p is None else TableCell(p_text(p), p) for name, p in t_tests.items()},
        "cohen_dz": undefined if tests.cohen_dz is None else _signed(tests.cohen_dz, 2),
        "rank_biserial": _signed(tests.rank_biserial, 2),
    }


def _signed(value: float, decimals: int) -> TableCell:
    text = number_text(value, decimals)
    return TableCell(f"+{text}" if value > 0 and text.strip("0.") else text, value)


def statistics_text(study: Study, compared: Sequence[RivalComparison], reference: str, chosen: bool) -> list[str]:
    """Sentences on the unit, the number of scenes and the smallest possible p of one metric; or why no test is run.

    They tell what was decided beforehand, and the family that p-values are adjusted for. A reference that was not
    chosen beforehand, but for being the best, is warned of.
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
    rivals = _family(study, reference)
    text = [
        f"Paired over {counted(most, 'scene')}: the unit is the scene, not the frame. The smallest p that the "
        f"two-sided Wilcoxon signed-rank test can give is {smallest_p_text(most)}, or {smallest_p_text(most, rivals)} "
        f"after Holm's adjustment for {counted(rivals, 'rival')}."
    ]
    if min(1.0, rivals * smallest_p(most)) >= LEVELS[0]:
        needed = next(count for count in range(most, 100) if rivals * smallest_p(count) < LEVELS[0])
        text.append(f"No star is possible, as that is not below {p_text(LEVELS[0])}; it takes {needed} scenes.")
    text += ["The adjustment counts every method that was planned or given.", _decision_text(study, reference)]
    if not chosen:
        text.append(
            f"{reference} is the reference because it came out best, so that the p-values are too small: choose one "
            "beforehand, with --reference."
        )
    return text


def _decision_text(study: Study, reference: str) -> str:
    """Sentences on the pre-registered reference and metrics, and on which p-values are exploratory."""
    decided = study.decided
    if decided is None:
        return (
            "All p-values are exploratory, without stars: reference and primary metrics were not decided before the "
            "first run (`coliags compare --reference METHOD --primary METRIC`)."
        )
    text = (
        f"Decided on {decided.date}, before the first run: {decided.reference} is compared with the others by "
        f"{', '.join(map(metric_title, decided.primary))}."
    )
    if is_decided(study, reference):
        return f"{text} p-values of other metrics are exploratory, without stars."
    return f"{text} {reference} is another reference, so that all p-values are exploratory, without stars."


def p_text(p: float, digits: int = 2) -> str:
    """A p-value with significant digits, without a leading zero; ``1`` and ``< .0001`` at the ends."""
    return "< .0001" if p < _SMALLEST_PRINTED else f"{p:.{digits}g}".removeprefix("0")


def smallest_p_text(scenes: int, rivals: int = 1) -> str:
    """The smallest p that so many scenes can give, adjusted for so many rivals."""
    return p_text(min(1.0, rivals * smallest_p(scenes)), digits=3)
