"""What a table says where a value is missing or leaves something out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from coliags_plugin.comparison.report.metric_columns import empty_metrics
from coliags_plugin.comparison.report.study import MetricValues, Part, Study
from coliags_plugin.comparison.report.tables import Column
from coliags_plugin.results.spread import common_scenes


def shared_scenes(values: MetricValues) -> list[str]:
    """Scenes that every method with a value has; a method without any does not count."""
    return common_scenes([by_scene for by_scene in values.values() if by_scene])


def summary_note(
    study: Study, part: Part, column: Column, method: str, values: Mapping[str, object], shared: Sequence[str]
) -> str:
    """Footnote of a mean over scenes: why it is missing, or what it leaves out.

    Args:
        study: The results.
        part: Test set and split.
        column: Metric.
        method: Row.
        values: The method's, by scene.
        shared: Scenes of the mean.
    """
    scenes = [scene for scene in study.scenes(part) if study.runs(part, scene, method)]
    if not scenes:
        return f"{method}: no result"
    if not values:
        return f"{column.title}: {study.reason(part, method, column.key)}"
    if not shared:
        return f"{column.title}: no scene that all methods have"
    lacking = [scene for scene in scenes if scene not in values]
    if lacking:
        reason = study.reason(part, method, column.key, lacking[0])
        return f"{column.title}: not available for {', '.join(lacking)}; {reason}"
    return _partial_note(study, part, column, method, shared)


def scene_note(study: Study, part: Part, column: Column, method: str, scene: str, value: float | None) -> str:
    """Footnote of a value of one scene: why it is missing, or which frames it leaves out."""
    if not study.runs(part, scene, method):
        return f"{method}: no result"
    if value is None:
        return f"{column.title}: {study.reason(part, method, column.key, scene)}"
    return _partial_note(study, part, column, method, [scene])


def _partial_note(study: Study, part: Part, column: Column, method: str, scenes: Sequence[str]) -> str:
    """What a mean leaves out where some frames lack the metric; empty where none does."""
    having = total = 0
    for scene in scenes:
        for cell in study.runs(part, scene, method):
            record = cell.result.sets[part.set_name]
            having += sum(value is not None for value in record.values.get(column.key, ()))
            total += len(record.frames)
    if having == total:
        return ""
    return f"{column.title}: mean over {having} of {total} frames; {study.reason(part, method, column.key)}"


def not_shown_notes(study: Study, part: Part, columns: Sequence[Column]) -> list[str]:
    """Which metrics are not shown for lack of any value, and why, together where the reason is the same."""
    empty, by_reason = empty_metrics(study, part), dict[str, list[str]]()
    for column in columns:
        if column.key in empty and not column.shown:
            by_reason.setdefault(study.reason(part, study.methods[0], column.key), []).append(column.title)
    return [f"Not shown, without values: {'; '.join(titles)}: {reason}" for reason, titles in by_reason.items()]


def left_out_notes(study: Study, part: Part, columns: Sequence[Column]) -> list[str]:
    """Which scenes the means leave out, together for the columns that leave out the same."""
    scenes = study.scenes(part)
    titles: dict[tuple[str, ...], list[str]] = {}
    for column in columns:
        values = study.values(part, column.key)
        shared = shared_scenes(values)
        if any(values.values()):
            titles.setdefault(tuple(scene for scene in scenes if scene not in shared), []).append(column.title)
    return [
        ("Means" if len(titles) == 1 else f"{'; '.join(columns_of)}: means")
        + f" over {len(scenes) - len(missing)} of {len(scenes)} scenes, without {', '.join(missing)}, "
        "which not every method has"
        for missing, columns_of in titles.items()
        if missing
    ]
