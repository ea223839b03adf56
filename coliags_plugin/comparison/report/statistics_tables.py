"""Tables of a reference's lead over its rivals: tests, intervals and effect sizes."""

from __future__ import annotations

from collections.abc import Sequence

from coliags_plugin.comparison.report.metric_columns import metric_columns, part_name, part_title
from coliags_plugin.comparison.report.missing_values import shared_scenes
from coliags_plugin.comparison.report.statistics_text import p_text, smallest_p_text
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, column_decimals, number_text, unit_text
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.results.comparisons import RivalComparison, compare_with_rivals
from coliags_plugin.results.paired import FEWEST_SCENES, smallest_p
from coliags_plugin.results.spread import spread

#: The reference where it is among the methods.
PREFERRED = "coliags"


def choose_reference(study: Study, chosen: str | None) -> str:
    """The method that the others are compared with: the one chosen, else ``coliags``, else the best.

    Raises:
        InputError: The chosen one is not among the methods.
    """
    if chosen is None:
        if PREFERRED in study.methods:
            return PREFERRED
        part = study.parts[0]
        return _best(study, part, metric_columns(study, part)[0])
    if chosen not in study.methods:
        known = ", ".join(study.methods)
        raise InputError(
            f"--reference {chosen}: no such method", f"one of {known}", did_you_mean(chosen, study.methods)
        )
    return chosen


def _best(study: Study, part: Part, column: Column) -> str:
    """The method that is best by one metric; the first one where none has a value."""
    values = study.values(part, column.key)
    shared = shared_scenes(values)
    means = {method: spread(by_scene, shared).mean for method, by_scene in values.items() if by_scene and shared}
    sign = 1.0 if column.direction == "higher" else -1.0
    return max(means, key=lambda method: sign * means[method]) if means else study.methods[0]


def compare(study: Study, part: Part, column: Column, reference: str) -> list[RivalComparison]:
    """The reference compared with every other method by one metric; empty where it has no value."""
    values = study.values(part, column.key)
    if column.direction is None or not values[reference]:
        return []
    rivals = {method: by_scene for method, by_scene in values.items() if by_scene}
    return compare_with_rivals(rivals, reference, column.direction == "higher")


def comparison_table(
    study: Study, part: Part, column: Column, compared: Sequence[RivalComparison], reference: str
) -> Table:
    """Lead of the reference by one metric over each rival, with tests where there are enough scenes."""
    unit = unit_text(column.unit)
    tested = any(row.tests for row in compared)
    columns = [
        Column("scenes", "Scenes"),
        Column("lead", "Lead", column.unit),
        Column("better", "Better on"),
    ]
    if tested:
        columns += [
            Column("interval", "95 % interval", column.unit),
            Column("smallest", "Smallest p"),
            Column("wilcoxon", "Wilcoxon p"),
            Column("wilcoxon_holm", "Holm"),
            Column("t_test", "t-test p"),
            Column("t_test_holm", "Holm"),
            Column("cohen_dz", "Cohen's d"),
            Column("rank_biserial", "Rank-biserial"),
        ]
    decimals = column_decimals(column.unit, [row.lead for row in compared])
    rows = [Row(row.rival, _entries(row, decimals, tested), study.methods.index(row.rival)) for row in compared]
    return Table(
        title=f"{column.title}: lead of {reference}",
        count=part_title(study, part) + (f", {unit}" if unit else ""),
        head="Over",
        columns=tuple(columns),
        rows=tuple(rows),
        name=f"lead-{part_name(study, part)}-{column.key}",
    )


def _entries(row: RivalComparison, decimals: int, tested: bool) -> tuple[Entry, ...]:
    scenes = len(row.scenes)
    entries = [
        Entry(str(scenes), scenes),
        Entry(note="no scene in common") if row.lead is None else Entry(_signed(row.lead, decimals), row.lead),
        Entry(f"{row.better_on} of {scenes}", row.better_on),
    ]
    if not tested:
        return tuple(entries)
    if row.tests is None:
        return (*entries, *(Entry(note=f"fewer than {FEWEST_SCENES} scenes in common") for _ in range(8)))
    tests = row.tests
    low, high = tests.interval
    undefined = Entry(note="all differences are equal")
    return (
        *entries,
        Entry(f"{_signed(low, decimals)} to {_signed(high, decimals)}", low),
        Entry(smallest_p_text(scenes), smallest_p(scenes)),
        _p_entry(tests.wilcoxon) or undefined,
        Entry(p_text(tests.wilcoxon_holm), tests.wilcoxon_holm, stars=row.stars),
        _p_entry(tests.t_test) or undefined,
        _p_entry(tests.t_test_holm) or undefined,
        undefined if tests.cohen_dz is None else Entry(_signed(tests.cohen_dz, 2), tests.cohen_dz),
        Entry(_signed(tests.rank_biserial, 2), tests.rank_biserial),
    )


def _p_entry(p: float | None) -> Entry | None:
    return None if p is None else Entry(p_text(p), p)


def _signed(value: float, decimals: int) -> str:
    text = number_text(value, decimals)
    return f"+{text}" if value > 0 and text.strip("0.") else text
