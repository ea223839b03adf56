"""Section of single frames: the worst first, charts along the video, and all values as CSV."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Sequence

from coliags_plugin.comparison.report.frame_values import frame_means, per_frame_csv
from coliags_plugin.comparison.report.html_blocks import folded, html_table, legend
from coliags_plugin.comparison.report.metric_columns import metric_columns, part_name, part_title
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.comparison.report.tables import Column, Row, Table, counted, numeric_entries
from coliags_plugin.outputs.charts import Series, line_chart

#: Frames of a table of the worst ones.
_WORST = 15


def frame_section(study: Study, chosen: Sequence[str], reference: str) -> str:
    """HTML section.

    Args:
        study: The results.
        chosen: Columns that the reader chose.
        reference: Method by whose values the frames are sorted.
    """
    csv = b64encode(per_frame_csv(study).encode()).decode("ascii")
    parts = [
        "<section><h2>Every frame</h2>",
        f'<p class="hint"><a download="per_frame.csv" href="data:text/csv;base64,{csv}">per_frame.csv</a>: every '
        "metric of every frame, method and seed.</p>",
        *(_worst_frames(study, part, chosen, reference) for part in study.parts),
        *_charts(study),
        "</section>",
    ]
    return "\n".join(parts)


def _worst_frames(study: Study, part: Part, chosen: Sequence[str], reference: str) -> str:
    tables = [
        table
        for column in metric_columns(study, part, chosen)
        if column.shown and (table := worst_table(study, part, column, reference)) is not None
    ]
    title = f"Worst frames of {reference}, {part_title(study, part)}"
    return folded(title, map(html_table, tables)) if tables else ""


def worst_table(study: Study, part: Part, column: Column, reference: str) -> Table | None:
    """The reference's worst frames by one metric, with the values of all methods; None without any value."""
    values = {
        method: {
            (scene, frame): value
            for scene in study.scenes(part)
            for frame, value in frame_means(study, part, scene, method, column.key).items()
        }
        for method in study.methods
    }
    sign = 1.0 if column.direction == "higher" else -1.0
    worst = sorted(values[reference], key=lambda place: sign * values[reference][place])[:_WORST]
    if not worst:
        return None
    several = len(study.scenes(part)) > 1
    columns = [numeric_entries([own.get(place) for place in worst], column.unit, None) for own in values.values()]
    rows = [
        Row(f"{scene} · {frame}" if several else frame, tuple(own[index] for own in columns))
        for index, (scene, frame) in enumerate(worst)
    ]
    total = len(values[reference])
    return Table(
        title=f"Lowest {column.title}" if column.direction == "higher" else f"Highest {column.title}",
        count=f"{len(worst)} of {counted(total, 'frame')}",
        head="Frame",
        columns=tuple(Column(method, method, column.unit) for method in study.methods),
        rows=tuple(rows),
        name=f"worst-{part_name(study, part)}-{column.key}",
    )


def _charts(study: Study) -> list[str]:
    parts = []
    for scene in study.scenes():
        figures = [html for part in study.parts if (html := _chart(study, part, scene))]
        charts = f'{legend(study.methods)}<div class="charts">{"".join(figures)}</div>'
        title = f"PSNR of each frame of {scene}"
        if figures:
            parts.append(folded(title, [charts], is_open=len(study.scenes()) == 1))
    return parts


def _chart(study: Study, part: Part, scene: str) -> str:
    names = list(study.frames(part, scene))
    lines = []
    for style, method in enumerate(study.methods):
        values = frame_means(study, part, scene, method, "psnr")
        if values:
            along = [float(index) for index in range(len(names))]
            lines.append(Series(method, style, along, [values.get(name, math.nan) for name in names]))
    chart = line_chart(lines, "frame", "PSNR [dB]", x_names=names, markers=True)
    return f"<figure><h4>{part_title(study, part)}</h4>{chart}</figure>" if chart else ""
