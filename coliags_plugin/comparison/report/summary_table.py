"""Table of every method's metrics over all scenes, with spread, ranks, stars and published numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.metric_columns import part_name, part_title
from coliags_plugin.comparison.report.missing_values import left_out_notes, not_shown_notes, shared_scenes, summary_note
from coliags_plugin.comparison.report.published import PublishedBenchmark
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, counted, numeric_entries
from coliags_plugin.results.comparisons import LEVELS, RivalComparison
from coliags_plugin.results.spread import Spread, spread

#: Comparisons by metric.
Comparisons = Mapping[str, Sequence[RivalComparison]]


def summary_table(
    study: Study,
    part: Part,
    columns: Sequence[Column],
    comparisons: Comparisons,
    published: PublishedBenchmark | None = None,
) -> Table:
    """Mean of every metric over the scenes that all methods have, with its standard deviation over them.

    Args:
        study: The results.
        part: Test set and split.
        columns: Metrics.
        comparisons: For the stars; metrics without one have none.
        published: Numbers to show below ours.
    """
    entries = [_entries(study, part, column, comparisons.get(column.key, ())) for column in columns]
    rows = [Row(method, tuple(own[index] for own in entries), index) for index, method in enumerate(study.methods)]
    return Table(
        title=part_title(study, part),
        count=_size(study, part),
        head="Method",
        columns=tuple(columns),
        rows=(*rows, *([] if published is None else _published_rows(published, columns))),
        notes=(
            *not_shown_notes(study, part, columns),
            *left_out_notes(study, part, columns),
            *_spread_note(study, part, rows),
            *_star_note(comparisons),
            *([] if published is None else [published.note]),
        ),
        name=f"summary-{part_name(study, part)}",
    )


def _entries(study: Study, part: Part, column: Column, compared: Sequence[RivalComparison]) -> list[Entry]:
    values = study.values(part, column.key)
    shared = shared_scenes(values)
    found = [spread(by_scene, shared) if by_scene and shared else None for by_scene in values.values()]
    means = [None if own is None else own.mean for own in found]
    entries = numeric_entries(means, column.unit, column.direction, [_shown_spread(own) for own in found])
    stars = {row.rival: row.stars for row in compared}
    return [
        replace(
            entry,
            stars=stars.get(method, ""),
            note=summary_note(study, part, column, method, values[method], shared),
        )
        for method, entry in zip(study.methods, entries, strict=True)
    ]


def _shown_spread(found: Spread | None) -> float | None:
    """Over scenes; over the seeds of a single scene."""
    if found is None:
        return None
    return found.over_scenes if found.scenes > 1 else found.over_seeds


def _size(study: Study, part: Part) -> str:
    scenes = study.scenes(part)
    frames = counted(sum(len(study.frames(part, scene)) for scene in scenes), "frame")
    return frames if len(scenes) == 1 else f"{counted(len(scenes), 'scene')}, {frames}"


def _spread_note(study: Study, part: Part, rows: Sequence[Row]) -> list[str]:
    if not any(entry.spread for row in rows for entry in row.entries):
        return []
    return [f"± standard deviation over {'scenes' if len(study.scenes(part)) > 1 else 'seeds'}"]


def _star_note(comparisons: Comparisons) -> list[str]:
    if not any(row.stars for rows in comparisons.values() for row in rows):
        return []
    levels = ", ".join(f"{'*' * (index + 1)} p < {f'{level:g}'[1:]}" for index, level in enumerate(LEVELS))
    return [f"Differs from the reference: {levels} (Wilcoxon signed-rank test over scenes, Holm)"]


def _published_rows(published: PublishedBenchmark, columns: Sequence[Column]) -> list[Row]:
    return [
        Row(
            f"{method}, published",
            tuple(_published_entry(numbers.get(column.key)) for column in columns),
            published=True,
        )
        for method, numbers in published.methods.items()
    ]


def _published_entry(printed: str | None) -> Entry:
    return Entry() if printed is None else Entry(printed, float(printed))
