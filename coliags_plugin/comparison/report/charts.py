"""Charts of a report: errors against distance and angle, training curves, and PSNR along the video."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coliags_plugin.comparison.report.study import Study, TestSet, grouped
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.reporting.model import Chart, Figures, Folded, Paragraph, Series, Template
from coliags_plugin.results.comparisons import common_scenes
from coliags_plugin.results.record import ProfileRecord

#: Bins with a smaller share of the pixels are left out.
_SMALLEST_SHARE = 1e-3
#: Curves of more logged steps are averaged over this many intervals.
_MOST_POINTS = 120
#: Columns of the log against which curves are drawn: group of the charts, and label of the axis.
_TRAINING_AXES = {"step": ("by-step", "step"), "seconds": ("by-seconds", "training time [s]")}
#: Columns of the log that are drawn: label of the axis, and title of the chart.
_TRAINING_CURVES = {
    "psnr": ("training PSNR [dB]", "PSNR of the training view at each step"),
    "loss": ("loss, log scale", "Loss"),
}
#: Training log of a run: method, its style, and the columns.
_Log = tuple[str, int, Mapping[str, np.ndarray]]


def profiles(study: Study) -> Folded:
    """Errors against distance and angle; without blocks where no result has profiles."""
    explanation = Paragraph(
        "Over the pixels with known depth, all frames and scenes together: PSNR from the mean squared colour error, "
        "and the root mean square of the depth error, drawn at the middle of each bin. Bins with less than "
        f"{_SMALLEST_SHARE:.1%} of the pixels are left out. The light of a scope falls with both."
    )
    charts = {test_set.title: _profile_charts(test_set) for test_set in study.test_sets}
    figures = [Figures(group, title, study.methods) for title, group in charts.items() if group]
    return Folded("Error against distance and angle", [explanation, *figures] if figures else [])


def _profile_charts(test_set: TestSet) -> list[Chart]:
    """PSNR and depth error against distance and angle, over the scenes that all methods with profiles have."""
    charts, study, unit = [], test_set.study, test_set.study.length_unit
    axes = {"distance": f"distance to the camera [{unit}]", "angle": "angle to the optical axis [degrees]"}
    for name, x_label in axes.items():
        recorded = [(run, record.profiles[name]) for run, record in test_set.records if name in record.profiles]
        by_method = {
            method: grouped(pairs, lambda pair: pair[0].scene)
            for method, pairs in grouped(recorded, lambda pair: pair[0].method).items()
        }
        shared = common_scenes([*by_method.values()])
        profiles = {
            method: [profile for scene in shared for _, profile in by_scene[scene]]
            for method, by_scene in by_method.items()
        }
        for title, y_label in {"PSNR": "PSNR [dB]", "Depth error": f"RMS depth error [{unit}]"}.items():
            lines = [
                _profile_line(method, study.methods.index(method), pooled, of_depth=title != "PSNR")
                for method, pooled in profiles.items()
                if len({profile.edges for profile in pooled}) == 1
            ]
            charts.append(Chart(lines, x_label, y_label, f"{title} against {name}", markers=True))
    return [chart for chart in charts if chart.has_points]


def _profile_line(method: str, style: int, profiles: Sequence[ProfileRecord], of_depth: bool) -> Series:
    """Mean squared errors per bin over several profiles, weighted by their pixels; NaN where one is missing."""
    edges = np.array(profiles[0].edges)
    pixels = np.array([profile.pixels for profile in profiles], dtype=np.float64)
    errors = [profile.depth_mse if of_depth else profile.rgb_mse for profile in profiles]
    values = np.array(errors, dtype=np.float64)  # NaN for None
    total = pixels.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        means = np.where(pixels > 0, pixels * values, 0.0).sum(axis=0) / np.where(total > 0, total, math.nan)
        shown = np.sqrt(means) if of_depth else -10.0 * np.log10(means)
    enough = total >= _SMALLEST_SHARE * total.sum()
    return Series(method, style, ((edges[:-1] + edges[1:]) / 2.0)[enough].tolist(), shown[enough].tolist())


def training(study: Study) -> Folded:
    """Curves of every scene against steps and seconds; says so where there is no log."""
    logs: dict[str, list[_Log]] = {}
    for style, runs in enumerate(study.by_method.values()):
        for run in runs:
            if run.run is not None and (columns := RunFolder(run.run).history()):
                logs.setdefault(run.scene, []).append((run.method, style, columns))
    if not logs:
        text = "No training log: only results files are here, or runs without metrics.jsonl."
        return Folded("Training", [Paragraph(text)])
    hint = (
        f"Curves of more than {_MOST_POINTS} logged steps are means over intervals. There is one for each seed. Each "
        "method has a loss of its own: compare the shapes of the curves, not their levels."
    )
    folded = [
        Folded(scene, [Figures(_training_charts(logs[scene]), legend=study.methods)])
        for scene in study.scenes
        if scene in logs
    ]
    folded[0] = replace(folded[0], is_open=True)
    shown = folded if len(folded) > 1 else folded[0].blocks
    return Folded("Training", [Template("curves.html"), Paragraph(hint), *shown])


def _training_charts(logs: Sequence[_Log]) -> list[Chart]:
    charts = []
    for x, (group, x_label) in _TRAINING_AXES.items():
        for y, (y_label, title) in _TRAINING_CURVES.items():
            lines = [
                Series(method, style, *_smoothed(columns[x], columns[y]))
                for method, style, columns in logs
                if x in columns and y in columns
            ]
            charts.append(Chart(lines, x_label, y_label, title, log_y=y == "loss", group=group))
    return charts


def _smoothed(along: np.ndarray, values: np.ndarray) -> tuple[list[float], list[float]]:
    """Points of a curve; of many, means over intervals."""
    along, values = along[np.isfinite(along)], values[np.isfinite(along)]
    if len(along) > _MOST_POINTS:
        intervals = np.array_split(np.arange(len(along)), _MOST_POINTS)
        finite = [index for index in (each[np.isfinite(values[each])] for each in intervals) if index.size]
        along, values = (np.array([column[index].mean() for index in finite]) for column in (along, values))
    return along.tolist(), values.tolist()


def frame_charts(study: Study) -> list[Folded]:
    """PSNR of each frame of every scene."""
    folded = []
    for scene in study.scenes:
        charts = []
        for test_set in study.test_sets:
            names, lines = list(test_set.frames(scene)), []
            for style, method in enumerate(study.methods):
                values = test_set.frame_means(scene, method, "psnr")
                psnr = [values.get(name, math.nan) for name in names]
                lines.append(Series(method, style, [*map(float, range(len(names)))], psnr))
            charts.append(Chart(lines, "frame", "PSNR [dB]", test_set.title, x_names=names, markers=True))
        if charts := [chart for chart in charts if chart.has_points]:
            figures = Figures(charts, legend=study.methods)
            folded.append(Folded(f"PSNR of each frame of {scene}", [figures], is_open=len(study.scenes) == 1))
    return folded
