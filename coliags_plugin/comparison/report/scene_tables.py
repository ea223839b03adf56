"""Tables of metrics on single scenes, and of their spread over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from coliags_plugin.comparison.report.metric_columns import part_name, part_title
from coliags_plugin.comparison.report.missing_values import scene_note, shared_scenes
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.comparison.report.tables import Column, Entry, Row, Table, counted, numeric_entries
from coliags_plugin.results.spread import spread


def scene_table(study: Study, part: Part, columns: Sequence[Column], scene: str) -> Table:
    """Means over one scene's frames, and over seeds."""
    entries = [_entries(study, part, column, scene) for column in columns]
    seeds = max(len(study.runs(part, scene, method)) for method in study.methods)
    return Table(
        title=f"{scene}, {part_title(study, part)}",
        count=counted(len(study.frames(part, scene)), "frame"),
        head="Method",
        columns=tuple(columns),
        rows=_rows(study, entries),
        notes=("± standard deviation over seeds",) if seeds > 1 else (),
        name=f"scene-{scene}-{part_name(study, part)}",
    )


def _entries(study: Study, part: Part, column: Column, scene: str) -> list[Entry]:
    values = study.values(part, column.key)
    seeds = [values[method].get(scene, {}) for method in study.methods]
    found = [spread({scene: own}, [scene]) if own else None for own in seeds]
    means = [None if own is None else own.mean for own in found]
    spreads = [None if own is None else own.over_seeds for own in found]
    entries = numeric_entries(means, column.unit, column.direction, spreads)
    return [
        replace(entry, note=scene_note(study, part, column, method, scene, entry.value))
        for method, entry in zip(study.methods, entries, strict=True)
    ]


def seed_table(study: Study, part: Part, columns: Sequence[Column]) -> Table | None:
    """Spread over seeds of every metric; None where no scene has two."""
    entries = [_seed_entries(study, part, column) for column in columns]
    if not any(entry.text for own in entries for entry in own):
        return None
    scenes = study.scenes(part)
    counts = {method: max(len(study.runs(part, scene, method)) for scene in scenes) for method in study.methods}
    shown = ", ".join(f"{method} {count}" for method, count in counts.items())
    return Table(
        title=f"Spread over seeds, {part_title(study, part)}",
        head="Method",
        columns=tuple(replace(column, direction=None) for column in columns),
        rows=_rows(study, entries),
        notes=(f"Root mean square over scenes of the standard deviation over the seeds of a scene. Seeds: {shown}",),
        name=f"seeds-{part_name(study, part)}",
    )


def _seed_entries(study: Study, part: Part, column: Column) -> list[Entry]:
    values = study.values(part, column.key)
    shared = shared_scenes(values)
    found = [spread(by_scene, shared).over_seeds if by_scene and shared else None for by_scene in values.values()]
    return numeric_entries(found, column.unit, None)


def _rows(study: Study, entries: Sequence[Sequence[Entry]]) -> tuple[Row, ...]:
    return tuple(Row(method, tuple(own[index] for own in entries), index) for index, method in enumerate(study.methods))
