"""Tables of metrics: means and medians over all scenes, on single scenes, and of the spread over seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.metric_columns import empty_metrics
from coliags_plugin.comparison.report.published import PublishedBenchmark
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.reporting.model import Column, Table, TableCell, ranked_cells
from coliags_plugin.reporting.numbers import counted
from coliags_plugin.results.comparisons import LEVELS, BySeed, RivalComparison, Spread, common_scenes, spread

#: Labels the rows.
METHOD = Column("method", "Method", words=True)


def method_rows(
    study: Study, columns: Sequence[Column], cells: Sequence[Sequence[TableCell]]
) -> list[dict[str, TableCell]]:
    """Rows of a table with one method each, of one cell per column and method."""
    keys = [column.key for column in columns]
    return [
        {METHOD.key: TableCell(method, style=style), **dict(zip(keys, own, strict=True))}
        for style, (method, *own) in enumerate(zip(study.methods, *cells, strict=True))
    ]


def shared_scenes(values: Mapping[str, BySeed]) -> list[str]:
    """Scenes that every method with a value has; a method without any does not count."""
    return common_scenes([by_scene for by_scene in values.values() if by_scene])


def spreads(values: Mapping[str, BySeed], scenes: Sequence[str]) -> list[Spread]:
    """Mean and spread of every method over scenes; of one without any value, None."""
    return [spread(by_scene, scenes if by_scene else ()) for by_scene in values.values()]


def summary_table(
    part: Part,
    columns: Sequence[Column],
    comparisons: Mapping[str, Sequence[RivalComparison]],
    published: PublishedBenchmark | None = None,
) -> Table:
    """Mean of every metric over the scenes that all methods have, with its standard deviation over them.

    Stars are of the comparisons, by metric; published numbers stand below ours.
    """
    cells = [_summary_cells(part, column, comparisons.get(column.key, ())) for column in columns]
    rows = method_rows(part.study, columns, cells)
    if published is not None:
        rows += [_published_row(method, columns, numbers) for method, numbers in published.methods.items()]
    frames = counted(sum(len(part.frames(scene)) for scene in part.scenes), "frame")
    several = len(part.scenes) > 1
    notes = [*_not_shown_notes(part, columns), *_left_out_notes(part, columns), *_ruled_notes(part, columns)]
    if any(cell.spread for own in cells for cell in own):
        notes.append(f"± standard deviation over {'scenes' if several else 'seeds'}")
    if any(row.stars for compared in comparisons.values() for row in compared):
        levels = ", ".join(f"{'*' * (index + 1)} p < {f'{level:g}'[1:]}" for index, level in enumerate(LEVELS))
        notes.append(f"Differs from the reference: {levels} (Wilcoxon signed-rank test over scenes, Holm)")
    return Table(
        title=part.title,
        columns=[METHOD, *columns],
        rows=rows,
        notes=[*notes, *([] if published is None else [published.note])],
        count=f"{counted(len(part.scenes), 'scene')}, {frames}" if several else frames,
        name=f"summary-{part.name}",
    )


def median_table(part: Part, columns: Sequence[Column]) -> Table | None:
    """Median over the same scenes of the metrics that are errors, which single scenes can rule; None of one scene."""
    errors = [column for column in columns if column.direction == "lower"]
    if len(part.scenes) < 2 or not any(column.shown for column in errors):
        return None
    cells = []
    for column in errors:
        values = part.values(column.key)
        medians = [own.median for own in spreads(values, shared_scenes(values))]
        cells.append(ranked_cells(medians, column.unit, column.direction))
    return Table(
        title=f"Medians over scenes, {part.title}",
        columns=[METHOD, *errors],
        rows=method_rows(part.study, errors, cells),
        name=f"medians-{part.name}",
    )


def _ruled_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """Of which methods the mean of an error is more than twice the median over scenes."""
    notes = []
    for column in (column for column in columns if column.shown and column.direction == "lower"):
        values = part.values(column.key)
        found = zip(part.study.methods, spreads(values, shared_scenes(values)), strict=True)
        ruled = [method for method, own in found if own.ruled_by_few]
        if ruled:
            notes.append(
                f"{column.title}: few scenes rule the mean, which is more than twice the median over scenes, of "
                f"{', '.join(ruled)}"
            )
    return notes


def _summary_cells(part: Part, column: Column, compared: Sequence[RivalComparison]) -> list[TableCell]:
    values = part.values(column.key)
    shared = shared_scenes(values)
    found = spreads(values, shared)
    over = [own.over_scenes if own.scenes > 1 else own.over_seeds for own in found]
    cells = ranked_cells([own.mean for own in found], column.unit, column.direction, over)
    stars = {row.rival: row.stars for row in compared}
    return [
        replace(cell, stars=stars.get(method, ""), note=_summary_note(part, column, method, values[method], shared))
        for method, cell in zip(part.study.methods, cells, strict=True)
    ]


def _published_row(method: str, columns: Sequence[Column], numbers: Mapping[str, str]) -> dict[str, TableCell]:
    cells = {column.key: numbers[column.key] for column in columns if column.key in numbers}
    label = TableCell(f"{method}, published", published=True)
    return {METHOD.key: label, **{key: TableCell(printed, float(printed)) for key, printed in cells.items()}}


def scene_table(part: Part, columns: Sequence[Column], scene: str) -> Table:
    """Means over one scene's frames, and over seeds."""
    seeds = max(len(part.runs(scene, method)) for method in part.study.methods)
    return Table(
        title=f"{scene}, {part.title}",
        columns=[METHOD, *columns],
        rows=method_rows(part.study, columns, [_scene_cells(part, column, scene) for column in columns]),
        notes=["± standard deviation over seeds"] if seeds > 1 else [],
        count=counted(len(part.frames(scene)), "frame"),
        name=f"scene-{scene}-{part.name}",
    )


def _scene_cells(part: Part, column: Column, scene: str) -> list[TableCell]:
    found = [spread(values, [scene] if scene in values else []) for values in part.values(column.key).values()]
    means, over_seeds = [own.mean for own in found], [own.over_seeds for own in found]
    cells = ranked_cells(means, column.unit, column.direction, over_seeds)
    return [
        replace(cell, note=_scene_note(part, column, method, scene, cell.value))
        for method, cell in zip(part.study.methods, cells, strict=True)
    ]


def seed_table(part: Part, columns: Sequence[Column]) -> Table | None:
    """Spread over seeds of every metric; None where no scene has two."""
    cells = []
    for column in columns:
        values = part.values(column.key)
        over_seeds = [own.over_seeds for own in spreads(values, shared_scenes(values))]
        cells.append(ranked_cells(over_seeds, column.unit, None))
    if not any(cell.text for own in cells for cell in own):
        return None
    counts = {method: max(len(part.runs(scene, method)) for scene in part.scenes) for method in part.study.methods}
    shown = ", ".join(f"{method} {count}" for method, count in counts.items())
    return Table(
        title=f"Spread over seeds, {part.title}",
        columns=[METHOD, *(replace(column, direction=None) for column in columns)],
        rows=method_rows(part.study, columns, cells),
        notes=[f"Root mean square over scenes of the standard deviation over the seeds of a scene. Seeds: {shown}"],
        name=f"seeds-{part.name}",
    )


def _summary_note(part: Part, column: Column, method: str, values: Mapping[str, object], shared: Sequence[str]) -> str:
    """Footnote of a mean over scenes: why it is missing, or what it leaves out."""
    scenes = [scene for scene in part.scenes if part.runs(scene, method)]
    if not scenes:
        return f"{method}: no result"
    if not values:
        return f"{column.title}: {part.reason(method, column.key)}"
    if not shared:
        return f"{column.title}: no scene that all methods have"
    lacking = [scene for scene in scenes if scene not in values]
    if lacking:
        reason = part.reason(method, column.key, lacking[0])
        return f"{column.title}: not available for {', '.join(lacking)}; {reason}"
    return _partial_note(part, column, method, shared)


def _scene_note(part: Part, column: Column, method: str, scene: str, value: float | None) -> str:
    """Footnote of a value of one scene: why it is missing, or which frames it leaves out."""
    if not part.runs(scene, method):
        return f"{method}: no result"
    if value is None:
        return f"{column.title}: {part.reason(method, column.key, scene)}"
    return _partial_note(part, column, method, [scene])


def _partial_note(part: Part, column: Column, method: str, scenes: Iterable[str]) -> str:
    """What a mean leaves out where some frames lack the metric; empty where none does."""
    records = [run.result.sets[part.set_name] for scene in scenes for run in part.runs(scene, method)]
    having = sum(value is not None for record in records for value in record.values.get(column.key, ()))
    total = sum(len(record.frames) for record in records)
    if having == total:
        return ""
    return f"{column.title}: mean over {having} of {total} frames; {part.reason(method, column.key)}"


def _not_shown_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """Which metrics are not shown for lack of any value, and why, together where the reason is the same."""
    empty, by_reason = empty_metrics(part), dict[str, list[str]]()
    for column in columns:
        if column.key in empty and not column.shown:
            by_reason.setdefault(part.reason(part.study.methods[0], column.key), []).append(column.title)
    return [f"Not shown, without values: {'; '.join(titles)}: {reason}" for reason, titles in by_reason.items()]


def _left_out_notes(part: Part, columns: Sequence[Column]) -> list[str]:
    """Which scenes the means leave out, together for the columns that leave out the same."""
    titles: dict[tuple[str, ...], list[str]] = {}
    for column in columns:
        values = part.values(column.key)
        shared = shared_scenes(values)
        if any(values.values()):
            titles.setdefault(tuple(scene for scene in part.scenes if scene not in shared), []).append(column.title)
    return [
        ("Means" if len(titles) == 1 else f"{'; '.join(columns_of)}: means")
        + f" over {len(part.scenes) - len(missing)} of {len(part.scenes)} scenes, without {', '.join(missing)}, "
        "which not every method has"
        for missing, columns_of in titles.items()
        if missing
    ]
