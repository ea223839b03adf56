"""Single frames: the worst ones in tables, and all of them as CSV."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence

from coliags_plugin.comparison.report.charts import frame_charts
from coliags_plugin.comparison.report.metric_columns import metric_columns
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.reporting.model import Column, Folded, Section, Table, Template, ranked_cells
from coliags_plugin.reporting.numbers import counted
from coliags_plugin.results.tables import csv_text, frame_rows

#: Frames of a table of the worst ones.
_WORST = 15


def per_frame_csv(study: Study) -> str:
    """One line per scene, test set, frame, method and seed, one column per metric; empty where there is no value."""
    rows = (
        [run.scene, run.result.scene.split, set_name, frame, run.method, run.result.seed, *values]
        for run in study.runs
        for set_name, frame, *values in frame_rows(run.result, study.metrics)
    )
    return csv_text(["scene", "split", "set", "frame", "method", "seed", *study.metrics], rows)


def frame_section(study: Study, chosen: Sequence[str], reference: str) -> Section:
    """The reference's worst frames first, charts along the video, and all values as CSV."""
    download = {
        "name": "per_frame.csv",
        "data": b64encode(per_frame_csv(study).encode()).decode("ascii"),
        "text": "every metric of every frame, method and seed.",
    }
    worst = []
    for part in study.parts:
        tables = [_worst_frames(part, column, reference) for column in metric_columns(part, chosen) if column.shown]
        if any(table.rows for table in tables):
            shown = [table for table in tables if table.rows]
            worst.append(Folded(f"Worst frames of {reference}, {part.title}", shown))
    return Section("Every frame", [Template("download.html", download), *worst, *frame_charts(study)], screen_only=True)


def _worst_frames(part: Part, column: Column, reference: str) -> Table:
    """The reference's worst frames by one metric, with the values of all methods."""
    methods, several = part.study.methods, len(part.scenes) > 1
    values = {
        method: {
            f"{scene} · {frame}" if several else frame: value
            for scene in part.scenes
            for frame, value in part.frame_means(scene, method, column.key).items()
        }
        for method in methods
    }
    sign = 1.0 if column.direction == "higher" else -1.0
    worst = sorted(values[reference], key=lambda frame: sign * values[reference][frame])[:_WORST]
    cells = [ranked_cells([values[method].get(frame) for frame in worst], column.unit, None) for method in methods]
    return Table(
        title=f"Lowest {column.title}" if column.direction == "higher" else f"Highest {column.title}",
        columns=[Column("frame name", "Frame", words=True), *(Column(method, unit=column.unit) for method in methods)],
        rows=[
            {"frame name": frame, **dict(zip(methods, own, strict=True))}
            for frame, *own in zip(worst, *cells, strict=True)
        ],
        count=f"{len(worst)} of {counted(len(values[reference]), 'frame')}",
        name=f"worst-{part.name}-{column.key}",
    )
