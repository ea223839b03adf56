"""Training curves against steps and against seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coliags_plugin.comparison.report.html_blocks import folded, legend
from coliags_plugin.comparison.report.study import Study
from coliags_plugin.comparison.report.training_log import read_training_log
from coliags_plugin.outputs.charts import Series, line_chart

#: Curves of more logged steps are averaged over this many intervals.
_MOST_POINTS = 120
#: Minimum-maximum bands are drawn for at most this many runs.
_MOST_BANDS = 3
#: Ratio of largest to smallest loss from which on the axis is logarithmic.
_LOG_FROM = 8.0
#: Columns of the log against which curves are drawn: class of the figure, and label of the axis.
_AXES = {"step": ("by-step", "step"), "seconds": ("by-seconds", "training time [s]")}


@dataclass(frozen=True)
class _Log:
    """Training log of one run, under its method's name and style."""

    method: str
    style: int
    columns: Mapping[str, np.ndarray]


def training_charts(study: Study) -> str:
    """HTML of the curves of every scene; says so where there is no log."""
    by_scene = {scene: logs for scene in study.scenes() if (logs := _logs(study, scene))}
    if not by_scene:
        return '<p class="hint">No training log: only results files are here, or runs without metrics.jsonl.</p>'
    parts = [_SWITCH, f'<p class="hint">{" ".join(_hints(study, [*by_scene.values()]))}</p>']
    for index, (scene, logs) in enumerate(by_scene.items()):
        charts = _charts(study, logs)
        parts.append(charts if len(by_scene) == 1 else folded(scene, [charts], is_open=index == 0))
    return "\n".join(parts)


#: Shown by the script alone; without it, curves are drawn against both.
_SWITCH = (
    '<fieldset class="switch" data-switch="curves" hidden><legend>Curves against</legend>'
    '<label><input type="radio" name="curves" value="by-step" checked> steps</label>'
    '<label><input type="radio" name="curves" value="by-seconds"> seconds</label></fieldset>'
)


def _logs(study: Study, scene: str) -> list[_Log]:
    found = []
    for style, (method, cells) in enumerate(study.by_method.items()):
        for cell in cells:
            if cell.scene == scene and cell.run is not None and (columns := read_training_log(cell.run)):
                found.append(_Log(method, style, columns))
    return found


def _charts(study: Study, logs: Sequence[_Log]) -> str:
    figures = []
    for x, (kind, label) in _AXES.items():
        for y, title, name in (
            ("psnr", "training PSNR [dB]", "PSNR of the training view at each step"),
            ("loss", "loss", "Loss"),
        ):
            chart = _chart(logs, x, y, label, title)
            if chart:
                figures.append(f'<figure class="{kind}"><h4>{name}</h4>{chart}</figure>')
    return f'{legend(study.methods)}<div class="charts">{"".join(figures)}</div>'


def _chart(logs: Sequence[_Log], x: str, y: str, x_label: str, y_label: str) -> str:
    lines = [_series(log, x, y, len(logs) <= _MOST_BANDS) for log in logs if x in log.columns and y in log.columns]
    values = [value for line in lines for value in line.y if math.isfinite(value)]
    logarithmic = y == "loss" and bool(values) and min(values) > 0.0 and max(values) / min(values) >= _LOG_FROM
    return line_chart(lines, x_label, f"{y_label}, log scale" if logarithmic else y_label, log_y=logarithmic)


def _series(log: _Log, x: str, y: str, bands: bool) -> Series:
    known = np.isfinite(log.columns[x])
    along, values = log.columns[x][known], log.columns[y][known]
    if len(along) <= _MOST_POINTS:
        return Series(log.method, log.style, along.tolist(), values.tolist())
    stretches = np.array_split(np.arange(len(along)), _MOST_POINTS)
    kept = [part for part in (part[np.isfinite(values[part])] for part in stretches) if part.size]
    low, high = ([float(f(values[part])) for part in kept] for f in (np.min, np.max))
    return Series(
        log.method,
        log.style,
        [float(along[part].mean()) for part in kept],
        [float(values[part].mean()) for part in kept],
        low if bands else (),
        high if bands else (),
    )


def _hints(study: Study, logs: Sequence[Sequence[_Log]]) -> list[str]:
    hints = []
    longest = max(len(values) for own in logs for log in own for values in log.columns.values())
    per_point = math.ceil(longest / _MOST_POINTS)
    if per_point > 1:
        band = "; the band spans their extremes" if max(map(len, logs)) <= _MOST_BANDS else ""
        hints.append(f"Each point is the mean of up to {per_point} logged steps{band}.")
    if len(study.methods) > 1:
        hints.append("Each method has a loss of its own: compare the shapes of the curves, not their levels.")
    if any(len({log.method for log in own}) < len(own) for own in logs):
        hints.append("One curve for each seed.")
    return hints
