"""Charts of a report: errors against distance and angle, training curves, and PSNR along the video."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coliags_plugin.comparison.report.study import Part, Study, StudyRun
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.outputs.charts import Series
from coliags_plugin.reporting.model import Block, Chart, Figures, Folded, Paragraph, Section, Template
from coliags_plugin.results.record import ProfileRecord

#: Bins with a smaller share of the pixels are left out.
_SMALLEST_SHARE = 1e-3
#: Ratio of largest to smallest depth error, and loss, from which on the axis is logarithmic.
_LOG_DEPTH_FROM, _LOG_LOSS_FROM = 20.0, 8.0
#: Curves of more logged steps are averaged over this many intervals.
_MOST_POINTS = 120
#: Columns of the log against which curves are drawn: group of the charts, and label of the axis.
_TRAINING_AXES = {"step": ("by-step", "step"), "seconds": ("by-seconds", "training time [s]")}


def profile_section(study: Study) -> Section:
    """Errors against distance and angle; without blocks where no result has profiles."""
    explanation = Paragraph(
        "Over the pixels with known depth, all frames and scenes together: PSNR from the mean squared colour error, "
        "and the root mean square of the depth error, drawn at the middle of each bin. Bins with less than "
        f"{_SMALLEST_SHARE:.1%} of the pixels are left out. The light of a scope falls with both."
    )
    figures = [Figures(charts, part.title, study.methods) for part in study.parts if (charts := _profile_charts(part))]
    return Section("Error against distance and angle", [explanation, *figures] if figures else [], screen_only=True)


def _profile_charts(part: Part) -> list[Chart]:
    charts, unit = [], part.study.length_unit
    axes = {"distance": f"distance to the camera [{unit}]", "angle": "angle to the optical axis [degrees]"}
    for name, x_label in axes.items():
        profiles = {method: _profiles(part, method, name) for method in part.study.methods}
        for title, y_label in (("PSNR", "PSNR [dB]"), ("Depth error", f"RMS depth error [{unit}]")):
            lines = [
                _profile_line(method, style, own, of_depth=title != "PSNR")
                for style, (method, own) in enumerate(profiles.items())
                if own and len({profile.edges for profile in own}) == 1
            ]
            log = title != "PSNR" and _spans(lines, _LOG_DEPTH_FROM)
            charts.append(
                Chart(lines, x_label, _log_label(y_label, log), f"{title} against {name}", log_y=log, markers=True)
            )
    return [chart for chart in charts if chart.has_points]


def _profiles(part: Part, method: str, name: str) -> list[ProfileRecord]:
    """Of the scenes on which every method has them, so that all are of the same pixels."""
    having = [
        {scene for scene in part.scenes for run in part.runs(scene, other) if name in _profiles_of(part, run)}
        for other in part.study.methods
    ]
    known = [scenes for scenes in having if scenes]
    shared = [scene for scene in part.scenes if known and all(scene in scenes for scenes in known)]
    runs = [run for scene in shared for run in part.runs(scene, method)]
    return [own[name] for run in runs if name in (own := _profiles_of(part, run))]


def _profiles_of(part: Part, run: StudyRun) -> Mapping[str, ProfileRecord]:
    return run.result.sets[part.set_name].profiles


def _profile_line(method: str, style: int, profiles: Sequence[ProfileRecord], of_depth: bool) -> Series:
    """Mean squared errors per bin over several profiles, weighted by their pixels; NaN where one is missing."""
    edges = np.array(profiles[0].edges)
    pixels = np.array([profile.pixels for profile in profiles], dtype=np.float64)
    errors = [profile.depth_mse if of_depth else profile.rgb_mse for profile in profiles]
    values = np.array([[math.nan if error is None else error for error in own] for own in errors])
    total = pixels.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        means = np.where(pixels > 0, pixels * values, 0.0).sum(axis=0) / np.where(total > 0, total, math.nan)
        shown = np.sqrt(means) if of_depth else -10.0 * np.log10(means)
    enough = total >= _SMALLEST_SHARE * total.sum()
    return Series(method, style, ((edges[:-1] + edges[1:]) / 2.0)[enough].tolist(), shown[enough].tolist())


@dataclass(frozen=True)
class _Log:
    """Training log of one run, under its method's name and style."""

    method: str
    style: int
    columns: Mapping[str, np.ndarray]


def training_blocks(study: Study) -> list[Block]:
    """Curves of every scene against steps and seconds; says so where there is no log."""
    by_scene = {scene: logs for scene in study.scenes if (logs := _logs(study, scene))}
    if not by_scene:
        return [Paragraph("No training log: only results files are here, or runs without metrics.jsonl.")]
    figures = {scene: Figures(_training_charts(logs), legend=study.methods) for scene, logs in by_scene.items()}
    folded = [Folded(scene, [own], is_open=index == 0) for index, (scene, own) in enumerate(figures.items())]
    hints = Paragraph(" ".join(_training_hints(study, [*by_scene.values()])))
    return [Template("curves.html"), hints, *(folded if len(figures) > 1 else figures.values())]


def _logs(study: Study, scene: str) -> list[_Log]:
    return [
        _Log(method, style, columns)
        for style, (method, runs) in enumerate(study.by_method.items())
        for run in runs
        if run.scene == scene and run.run is not None and (columns := RunFolder(run.run).history())
    ]


def _training_charts(logs: Sequence[_Log]) -> list[Chart]:
    charts = []
    for x, (group, x_label) in _TRAINING_AXES.items():
        for y, y_label, title in (
            ("psnr", "training PSNR [dB]", "PSNR of the training view at each step"),
            ("loss", "loss", "Loss"),
        ):
            having = [log for log in logs if x in log.columns and y in log.columns]
            lines = [_training_line(log, x, y) for log in having]
            log = y == "loss" and _spans(lines, _LOG_LOSS_FROM)
            charts.append(Chart(lines, x_label, _log_label(y_label, log), title, log_y=log, group=group))
    return charts


def _training_line(log: _Log, x: str, y: str) -> Series:
    known = np.isfinite(log.columns[x])
    along, values = log.columns[x][known], log.columns[y][known]
    if len(along) > _MOST_POINTS:
        intervals = np.array_split(np.arange(len(along)), _MOST_POINTS)
        kept = [part for part in (part[np.isfinite(values[part])] for part in intervals) if part.size]
        along, values = (np.array([every[part].mean() for part in kept]) for every in (along, values))
    return Series(log.method, log.style, along.tolist(), values.tolist())


def _training_hints(study: Study, logs: Sequence[Sequence[_Log]]) -> list[str]:
    hints = []
    longest = max(len(values) for own in logs for log in own for values in log.columns.values())
    per_point = math.ceil(longest / _MOST_POINTS)
    if per_point > 1:
        hints.append(f"Each point is the mean of up to {per_point} logged steps.")
    if len(study.methods) > 1:
        hints.append("Each method has a loss of its own: compare the shapes of the curves, not their levels.")
    if any(len({log.method for log in own}) < len(own) for own in logs):
        hints.append("One curve for each seed.")
    return hints


def frame_charts(study: Study) -> list[Folded]:
    """PSNR of each frame of every scene."""
    folded = []
    for scene in study.scenes:
        charts = [chart for part in study.parts if (chart := _frame_chart(part, scene)).has_points]
        if charts:
            figures = Figures(charts, legend=study.methods)
            folded.append(Folded(f"PSNR of each frame of {scene}", [figures], is_open=len(study.scenes) == 1))
    return folded


def _frame_chart(part: Part, scene: str) -> Chart:
    names, lines = list(part.frames(scene)), []
    for style, method in enumerate(part.study.methods):
        values = part.frame_means(scene, method, "psnr")
        if values:
            along = [float(index) for index in range(len(names))]
            lines.append(Series(method, style, along, [values.get(name, math.nan) for name in names]))
    return Chart(lines, "frame", "PSNR [dB]", part.title, x_names=names, markers=True)


def _log_label(label: str, log: bool) -> str:
    return f"{label}, log scale" if log else label


def _spans(lines: Sequence[Series], ratio: float) -> bool:
    """Whether all values are positive, and the largest is so many times the smallest."""
    values = [value for line in lines for value in line.y if math.isfinite(value)]
    return bool(values) and min(values) > 0.0 and max(values) / min(values) >= ratio
