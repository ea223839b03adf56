"""A reference's lead over its rivals: tables of tests, intervals and effect sizes, and what they can say."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.report.metric_tables import metric_columns, metric_title, spreads
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import check_name
from coliags_plugin.reporting.model import Column, Table, TableCell
from coliags_plugin.reporting.numbers import column_decimals, counted, number_text, unit_text
from coliags_plugin.results.comparisons import (
    FEWEST_SCENES,
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
    if chosen is not None:
        check_name("method", chosen, study.methods)
    decided = None if study.decided is None else study.decided.reference
    return next((name for name in (chosen, decided, PREFERRED) if name in study.methods), None) or _best_method(study)


def _best_method(study: Study) -> str:
    """The method that is best by the first metric; the first one where none has a value."""
    column = metric_columns(study.parts[0])[0]
    found = spreads(study.parts[0].values(column.key))
    means = {method: own.mean for method, own in found.items() if own.mean is not None}
    sign = 1.0 if column.direction == "higher" else -1.0
    return max(means, key=lambda method: sign * means[method]) if means else study.methods[0]


def compare(part: Part, column: Column, reference: str) -> list[RivalComparison]:
    """Paired comparisons of the reference with every method by one metric; empty where it has no value."""
    values = part.values(column.key)
    if column.direction is None or not values[reference]:
        return []
    rivals = {method: by_scene for method, by_scene in values.items() if by_scene}
    return compare_with_rivals(rivals, reference, column.direction == "higher", part.study.rivals(reference))


def stars(study: Study, metric: str, reference: str, row: RivalComparison) -> str:
    """Stars of a comparison, if its reference and metric were decided before the first run; else none."""
    decided = study.decided
    is_decided = decided is not None and decided.reference == reference and metric in decided.primary
    return row.stars if is_decided else ""


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
        columns.append(Column("interval", "95 % t interval", column.unit))
        columns += [Column(key, title) for key, title in _TESTS.items()]
    decimals = column_decimals(column.unit, [row.lead for row in compared])
    untested = TableCell(note=f"fewer than {FEWEST_SCENES} scenes in common")
    rows: list[dict[str, TableCell | int]] = []
    for row in compared:
        cells = {each.key: untested for each in columns[4:]}
        if row.tests is not None:
            cells = _test_cells(row.tests, len(row.scenes), decimals, stars(part.study, column.key, reference, row))
        own: dict[str, TableCell | int] = {
            "over": TableCell(row.rival, style=part.study.methods.index(row.rival)),
            "scenes": len(row.scenes),
            "lead": TableCell(note="no scene in common") if row.lead is None else _signed(row.lead, decimals),
            "better": TableCell(f"{row.better_on} of {len(row.scenes)}", row.better_on),
        }
        rows.append({**own, **cells})
    return Table(
        title=f"{column.title}: lead of {reference}",
        columns=columns,
        rows=rows,
        count=part.title + (f", {unit}" if unit else ""),
        name=f"lead-{part.name}-{column.key}",
    )


def _test_cells(tests: PairedTests, scenes: int, decimals: int, marks: str) -> dict[str, TableCell]:
    low, high = (_signed(end, decimals) for end in tests.interval)
    undefined = TableCell(note="all differences are equal")
    t_tests = {"t_test": tests.t_test, "t_test_holm": tests.t_test_holm}
    return {
        "interval": TableCell(f"{low.text} to {high.text}", low.value),
        "smallest": TableCell(p_text(smallest_p(scenes), digits=3), smallest_p(scenes)),
        "wilcoxon": TableCell(p_text(tests.wilcoxon), tests.wilcoxon),
        "wilcoxon_holm": TableCell(p_text(tests.wilcoxon_holm), tests.wilcoxon_holm, stars=marks),
        **{name: undefined if p is None else TableCell(p_text(p), p) for name, p in t_tests.items()},
        "cohen_dz": undefined if tests.cohen_dz is None else _signed(tests.cohen_dz, 2),
        "rank_biserial": _signed(tests.rank_biserial, 2),
    }


def _signed(value: float, decimals: int) -> TableCell:
    text = number_text(value, decimals)
    return TableCell(f"+{text}" if value > 0 and text.strip("0.") else text, value)


def statistics_text(study: Study, compared: Sequence[RivalComparison], reference: str) -> str:
    """What the tests of one metric can say: unit, scenes, smallest p, family, stars; empty without a common scene."""
    most = max((len(row.scenes) for row in compared), default=0)
    if not most:
        return ""
    smallest = p_text(smallest_p(most), digits=3)
    if most < FEWEST_SCENES:
        return (
            f"No test is run: {counted(most, 'scene')} cannot tell methods apart. The unit is the scene, not the "
            f"frame, and of {counted(most, 'difference')} the two-sided Wilcoxon test cannot give less than p = "
            f"{smallest}; tests are run from {FEWEST_SCENES} scenes on "
            f"(p = {p_text(smallest_p(FEWEST_SCENES), digits=3)})."
        )
    rivals, decided = study.rivals(reference), "nothing"
    if study.decided is not None:
        metrics = ", ".join(map(metric_title, study.decided.primary))
        decided = f"{study.decided.reference} against the others by {metrics}, on {study.decided.date}"
    return (
        f"Paired over {counted(most, 'scene')}: the unit is the scene, not the frame. The smallest p that the "
        f"two-sided Wilcoxon signed-rank test can give is {smallest}, or "
        f"{p_text(min(1.0, rivals * smallest_p(most)), digits=3)} after Holm's adjustment for "
        f"{counted(rivals, 'rival')}: every method that was planned or given. Stars are for what was decided before "
        f"the first run ({decided}); all other p-values are exploratory."
    )


def p_text(p: float, digits: int = 2) -> str:
    """A p-value with significant digits, without a leading zero; ``1`` and ``< .0001`` at the ends."""
    return "< .0001" if p < _SMALLEST_PRINTED else f"{p:.{digits}g}".removeprefix("0")
