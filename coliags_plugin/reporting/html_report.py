"""Self-contained HTML report that compares runs of one scene, with embedded images and no scripts.

The same runs give the same bytes: the file contains neither the time nor the machine it was written on.
"""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.outputs.charts import Series, color_bar_svg, line_chart, style_classes
from coliags_plugin.outputs.colormaps import hatch
from coliags_plugin.outputs.image_files import encode_png
from coliags_plugin.outputs.page import leaves, plain, record, refuse_folder, write_page
from coliags_plugin.reporting.comparison_table import Column, columns, metric_title, unit_text
from coliags_plugin.reporting.run_data import SEEN_SUFFIX, EvaluatedRun, read_runs
from coliags_plugin.reporting.views import SCALE_PERCENTILE, EncodedImage, RunView, View, Views, read_views

_SET_TITLES = {"test": "test: held out along the path", "rotation": "rotation: beyond the path"}
#: Metrics shown under an image, where available.
_CAPTION_METRICS = ("psnr", "psnr_seen", "ssim", "ssim_seen", "depth_mae", "depth_mae_seen", "depth_mse")
_DASH = "\N{EN DASH}"
#: Curves of more logged steps are averaged over this many intervals.
_MOST_POINTS = 120
#: Minimum-maximum bands are drawn for at most this many runs.
_MOST_BANDS = 3
#: Ratio of largest to smallest loss from which on the axis is logarithmic.
_LOG_FROM = 8.0


def write_report(
    runs: Sequence[Path],
    output: Path,
    protocol: str = "paper",
    frames: int = 4,
    title: str | None = None,
    note: str | None = None,
) -> None:
    """Write an HTML comparison of runs of one scene: metrics, held-out views, depth errors, curves and costs.

    Args:
        runs: Run folders, evaluated by one protocol in one version.
        output: The HTML file to write; replaced if it is there.
        protocol: Name of the evaluation to read from each run.
        frames: Held-out views to show per test set.
        title: Heading; made from scene and methods if None.
        note: Remark shown under the heading.

    Raises:
        InputError: A run is missing, not evaluated, damaged, or not comparable with the others; or ``output`` cannot
            be written.
    """
    refuse_folder(output)
    read = read_runs(runs, protocol)
    views = read_views(read, frames)
    heading = title if title is not None else _default_title(read)
    sections = [_results(read), _held_out(read, views), _training(read), _per_frame(read), _provenance(read)]
    write_page(output, heading, _header(read, views, heading, note), sections)


def _default_title(runs: Sequence[EvaluatedRun]) -> str:
    scene = runs[0].record.scene
    if len(runs) == 1:
        return f"{runs[0].record.method} on {scene}"
    return f"{len(runs)} runs compared on {scene}"


# ---------------------------------------------------------------------------------------------------- heading


def _header(runs: Sequence[EvaluatedRun], views: Views, heading: str, note: str | None) -> str:
    record = runs[0].record
    sets = ", ".join(f"{len(frames)} {name}" for name, frames in runs[0].per_frame.items())
    facts = [
        ("Scene", record.scene),
        ("Methods", ", ".join(dict.fromkeys(run.record.method for run in runs))),
        ("Held-out frames", sets),
        ("Image size", f"{views.size[0]} \N{MULTIPLICATION SIGN} {views.size[1]} px"),
        ("Protocol", f"{record.protocol.name}, version {record.protocol.version}"),
        ("Trained with", _versions(runs)),
    ]
    parts = [f"<h1>{escape(heading)}</h1>"]
    if note:
        parts.append(f'<p class="note" role="note">{escape(note)}</p>')
    parts.append('<dl class="facts">')
    parts += [f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in facts if value]
    if record.protocol.description:
        description = escape(record.protocol.description)
        parts.append(f'<div class="wide"><dt>How the metrics are computed</dt><dd>{description}</dd></div>')
    parts.append("</dl>")
    cautions = _cautions(runs)
    if cautions:
        items = "".join(f"<li>{escape(caution)}</li>" for caution in cautions)
        parts.append(f'<ul class="cautions">{items}</ul>')
    return "\n".join(parts)


def _versions(runs: Sequence[EvaluatedRun]) -> str:
    versions = dict.fromkeys(str(run.provenance.get("package_version") or "") for run in runs)
    return ", ".join(f"coliags_plugin {version}" for version in versions if version)


def _cautions(runs: Sequence[EvaluatedRun]) -> list[str]:
    """Differences between the runs that limit their comparison: steps, versions, data."""
    cautions = []
    steps = {run.label: run.record.step for run in runs if run.record.step is not None}
    if len(set(steps.values())) > 1:
        each = ", ".join(f"{label} {step:,}" for label, step in steps.items())
        cautions.append(f"The runs were trained for different numbers of steps: {each}.")
    for key, what in (("package_version", "versions of the package"), ("git", "states of the source")):
        if len({str(run.provenance[key]) for run in runs if run.provenance.get(key) is not None}) > 1:
            cautions.append(f"The runs come from different {what}.")
    data = [dict(leaves(scene)) for scene in _recorded_scenes(runs).values()]
    keys = dict.fromkeys(key for one in data for key in one)
    differing = [key for key in keys if any(one.get(key) != data[0].get(key) for one in data)]
    if differing:
        cautions.append(f"The runs record different data, see Provenance: {', '.join(differing)}.")
    return cautions


def _recorded_scenes(runs: Sequence[EvaluatedRun]) -> dict[str, Mapping[str, Any]]:
    """Scene provenance of each run by label, where recorded."""
    scenes = {run.label: run.provenance.get("scene") for run in runs}
    return {label: scene for label, scene in scenes.items() if isinstance(scene, Mapping)}


# ---------------------------------------------------------------------------------------------------- metrics


def _results(runs: Sequence[EvaluatedRun]) -> str:
    how = (
        "Means over the frames of each set. ↑ higher is better, ↓ lower is better. "
        "Best in <b>bold</b>, second <u>underlined</u>, by the printed digits; equal values share a rank."
        if len(runs) > 1
        else "Means over the frames of each set. ↑ higher is better, ↓ lower is better."
    )
    parts = ["<section><h2>Metrics</h2>", f'<p class="hint">{how}</p>']
    parts += [_result_table(runs, name) for name in runs[0].per_frame]
    return "\n".join([*parts, "</section>"])


def _result_table(runs: Sequence[EvaluatedRun], set_name: str) -> str:
    table = columns(runs, set_name)
    footnotes: dict[str, str] = {}
    rows = []
    ranks = [column.ranks() for column in table]
    for index, run in enumerate(runs):
        cells = [f'<th scope="row" class="text">{_swatch(index)}{escape(run.label)}</th>']
        for column, places in zip(table, ranks, strict=True):
            cells.append(_result_cell(run, set_name, column, index, places[index], footnotes))
        rows.append(f"<tr>{''.join(cells)}</tr>")
    parts = [
        '<div class="scroll"><table class="results">',
        f"<caption>{_set_title(set_name)} {_count(len(runs[0].per_frame[set_name]), 'frame')}</caption>",
        f'<thead><tr><th scope="col" class="text">Method</th>{"".join(map(_result_head, table))}</tr></thead>',
        f"<tbody>{''.join(rows)}</tbody></table></div>",
    ]
    if footnotes:
        notes = "".join(f"<li><sup>{mark}</sup> {escape(text)}</li>" for text, mark in footnotes.items())
        parts.append(f'<ul class="footnotes">{notes}</ul>')
    return "\n".join(parts)


def _result_head(column: Column) -> str:
    arrow = {"higher": "↑", "lower": "↓", None: ""}[column.direction]
    title = f' title="{column.direction} is better"' if arrow else ""
    # Arrow and unit share the second line, so that all headings have two lines.
    under = f"{arrow} {escape(unit_text(column.unit))}".strip() or "&nbsp;"
    return f'<th scope="col">{escape(column.title)}<span class="unit"{title}>{under}</span></th>'


def _result_cell(
    run: EvaluatedRun, set_name: str, column: Column, index: int, place: int | None, footnotes: dict[str, str]
) -> str:
    value = column.values[index]
    if value is None:
        mark = _footnote(footnotes, f"{column.title}: {run.reason(column.metric)}")
        return f'<td class="null">{_DASH}{mark}</td>'
    classes = {1: ' class="best"', 2: ' class="second"'}.get(place or 0, "")
    mark = ""
    having, frames = run.frames_with(set_name, column.metric), len(run.per_frame[set_name])
    if 0 < having < frames:
        reason = run.reason(column.metric)
        mark = _footnote(footnotes, f"{column.title}: mean over {having} of {frames} frames; {reason}")
    # A span, so that the underline is as wide as the number and not as the cell.
    return f"<td><span{classes}>{column.text(value)}</span>{mark}</td>"


def _footnote(footnotes: dict[str, str], text: str) -> str:
    """Superscript mark of a footnote; equal texts share one."""
    return f"<sup>{footnotes.setdefault(text, _mark(len(footnotes)))}</sup>"


def _mark(index: int) -> str:
    letters = "abcdefghijklmnopqrstuvwxyz"
    return (letters[index // 26 - 1] if index >= 26 else "") + letters[index % 26]


# ---------------------------------------------------------------------------------------------------- images


def _held_out(runs: Sequence[EvaluatedRun], views: Views) -> str:
    parts = ["<section><h2>Held-out views</h2>", f'<p class="hint">{_how_drawn(views)}</p>', _scales(views)]
    previous = None
    for view in views.views:
        if view.set_name != previous:
            parts.append(f"<h3>{_set_title(view.set_name)}</h3>")
            previous = view.set_name
        parts.append(_view(runs, view, views.error_kind))
    return "\n".join([*parts, "</section>"])


def _how_drawn(views: Views) -> str:
    percent = f"{SCALE_PERCENTILE:.0f} %"
    rule = f"it ends at the smallest 1, 2 or 5 times a power of ten below which {percent} of all errors shown lie"
    if views.error_kind == "depth":
        text = (
            "Under each rendering, its absolute depth error. One scale serves every run and every frame of this page: "
            f"{rule}. Errors beyond it, and missing depth where the truth has one, take its last colour."
        )
    else:
        text = (
            "These views have no true depth. Under each rendering, its absolute colour error, the mean of red, green "
            f"and blue. One scale serves every run and every frame of this page: {rule}."
        )
    if views.reduction > 1:
        text += f" Images are shown at 1/{views.reduction} of their size."
    return f"{text} Photographs are JPEG here; the run folders keep them as PNG."


def _scales(views: Views) -> str:
    if views.error_kind == "rgb":
        bar = color_bar_svg((0.0, views.error_limit), "levels of 255", "error", "|colour error|", "error-scale")
        return f'<div class="scales">{bar}</div>'
    parts = [color_bar_svg((0.0, views.error_limit), "mm", "error", "|depth error|", "error-scale")]
    if views.depth_limits is not None:
        parts.append(color_bar_svg(views.depth_limits, "mm", "depth", "true depth", "depth-scale"))
    sample = EncodedImage("image/png", encode_png(hatch(14, 34)), 34, 14)
    parts.append(
        f'<div class="unknown">{_img(sample, "grey hatch")}<span>no true depth (plain grey in true depth)</span></div>'
    )
    return f'<div class="scales">{"".join(parts)}</div>'


def _view(runs: Sequence[EvaluatedRun], view: View, error_kind: str) -> str:
    where = f"frame {view.frame}"
    parts = [
        f'<h4>{escape(where)} <span class="count">{view.position + 1} of {view.frames_in_set}</span></h4>',
        f'<div class="view" style="--cells: {1 + len(runs)}">',
        '<figure class="cell"><div class="name">truth</div>',
        _img(view.truth, f"{where}, true image"),
    ]
    if view.depth is not None:
        parts.append(_img(view.depth, f"{where}, true depth"))
        parts.append("<figcaption><span>above: camera image</span><span>below: true depth</span></figcaption>")
    elif error_kind == "depth":
        parts.append(_missing(view.truth, "no true depth"))
    parts.append("</figure>")
    for index, (run, part) in enumerate(zip(runs, view.runs, strict=True)):
        parts.append(f'<figure class="cell"><div class="name">{_swatch(index)}<span>{escape(run.label)}</span></div>')
        parts.append(_img(part.render, f"{where}, rendered by {run.label}"))
        if part.error is not None:
            kind = "depth" if error_kind == "depth" else "colour"
            parts.append(_img(part.error, f"{where}, absolute {kind} error of {run.label}"))
        else:
            parts.append(_missing(part.render, "no depth to compare"))
        parts.append(f"<figcaption>{_view_metrics(run, part)}</figcaption></figure>")
    return "\n".join([*parts, "</div>"])


def _view_metrics(run: EvaluatedRun, part: RunView) -> str:
    texts = []
    for metric in _CAPTION_METRICS:
        value = part.metrics.values.get(metric)
        if value is None or (metric == "depth_mse" and "depth_mae" in part.metrics.values):
            continue
        unit = run.record.units.get(metric, run.record.units.get(metric.removesuffix(SEEN_SUFFIX), ""))
        column = Column(metric, unit, None, [value])
        texts.append(
            f"<span>{escape(f'{metric_title(metric)} {column.text(value)} {unit_text(unit)}'.rstrip())}</span>"
        )
    return "".join(texts) or "no metrics for this frame"


def _img(image: EncodedImage, alt: str) -> str:
    source = f"data:{image.mime};base64,{b64encode(image.data).decode('ascii')}"
    return f'<img src="{source}" width="{image.width}" height="{image.height}" alt="{escape(alt, quote=True)}">'


def _missing(like: EncodedImage, text: str) -> str:
    return f'<div class="missing" style="aspect-ratio: {like.width} / {like.height}">{escape(text)}</div>'


# ---------------------------------------------------------------------------------------------------- training


def _training(runs: Sequence[EvaluatedRun]) -> str:
    parts = ["<section><h2>Training</h2>", _cost_table(runs)]
    logged = [run for run in runs if "step" in run.history]
    if not logged:
        parts.append('<p class="hint">No training log (metrics.jsonl) in these run folders.</p>')
        return "\n".join([*parts, "</section>"])
    charts = [
        (_curve(runs, "psnr", "training PSNR [dB]", log=False), "PSNR of the training view at each step"),
        (_curve(runs, "loss", "loss", log=True), "Loss"),
    ]
    drawn = [(chart, name) for chart, name in charts if chart]
    if drawn:
        parts.append(_legend(runs))
        figures = "".join(f"<figure><h4>{name}</h4>{chart}</figure>" for chart, name in drawn)
        parts.append(f'<div class="charts">{figures}</div>')
    hints = []
    per_point = max(math.ceil(len(run.history["step"]) / _MOST_POINTS) for run in logged)
    if per_point > 1:
        band = "; the band spans their extremes" if len(runs) <= _MOST_BANDS else ""
        hints.append(f"Each point is the mean of up to {per_point} logged steps{band}.")
    if len(runs) > 1:
        hints.append("Each method has a loss of its own: compare the shapes of the curves, not their levels.")
    parts.append(f'<p class="hint">{" ".join(hints)}</p>' if hints else "")
    return "\n".join([*parts, "</section>"])


def _curve(runs: Sequence[EvaluatedRun], column: str, label: str, log: bool) -> str:
    lines = [
        _series(run, index, column, bands=len(runs) <= _MOST_BANDS)
        for index, run in enumerate(runs)
        if "step" in run.history and column in run.history
    ]
    values = [value for line in lines for value in line.y if math.isfinite(value)]
    logarithmic = log and bool(values) and min(values) > 0.0 and max(values) / min(values) >= _LOG_FROM
    return line_chart(lines, "step", f"{label}, log scale" if logarithmic else label, log_y=logarithmic)


def _series(run: EvaluatedRun, style: int, column: str, bands: bool) -> Series:
    steps, values = run.history["step"], run.history[column]
    known = np.isfinite(steps)
    steps, values = steps[known], values[known]
    if len(steps) <= _MOST_POINTS:
        return Series(run.label, style, steps.tolist(), values.tolist())
    stretches = np.array_split(np.arange(len(steps)), _MOST_POINTS)
    kept = [part[np.isfinite(values[part])] for part in stretches]
    kept = [part for part in kept if part.size]
    edges = ([float(f(values[part])) for part in kept] for f in (np.min, np.max))
    low, high = edges if bands else ((), ())
    return Series(
        run.label,
        style,
        [float(steps[part].mean()) for part in kept],
        [float(values[part].mean()) for part in kept],
        low,
        high,
    )


def _cost_table(runs: Sequence[EvaluatedRun]) -> str:
    numbers = ("Steps", "Time", "Per step", "Gaussians", "Anchors")
    words = ("Device", "Renderer", "Seed")
    head = '<th scope="col" class="text">Run</th>'
    head += "".join(f'<th scope="col">{name}</th>' for name in numbers)
    head += "".join(f'<th scope="col" class="text">{name}</th>' for name in words)
    rows = []
    for index, run in enumerate(runs):
        row = f'<th scope="row" class="text">{_swatch(index)}{escape(run.label)}</th>'
        row += "".join(f"<td>{escape(cell)}</td>" for cell in _costs(run))
        for key in ("device", "renderer", "seed"):
            row += f'<td class="text">{escape(plain(run.provenance.get(key)) or _DASH)}</td>'
        rows.append(f"<tr>{row}</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _costs(run: EvaluatedRun) -> list[str]:
    """Table cells of a run: steps, time, time per step, final numbers of Gaussians and anchors."""
    step, planned = run.record.step, run.provenance.get("steps")
    steps = _DASH if step is None else f"{step:,}"
    if isinstance(planned, int) and step is not None and planned != step:
        steps += f" of {planned:,}"
    seconds, logged = run.last("seconds"), run.last("step")
    counts = [run.last(name) for name in ("gaussians", "anchors")]
    return [
        steps,
        _DASH if seconds is None else duration(seconds),
        _DASH if seconds is None or not logged else _pace(seconds / logged),
        *(_DASH if count is None else f"{count:,.0f}" for count in counts),
    ]


def _pace(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1.0 else f"{1000.0 * seconds:.3g} ms"


def duration(seconds: float) -> str:
    """Duration in at most two units, for instance ``2 min 05 s``."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes:02d} min"


def _per_frame(runs: Sequence[EvaluatedRun]) -> str:
    figures = []
    for set_name, frames in runs[0].per_frame.items():
        names = [frame.name for frame in frames]
        lines = [
            Series(
                run.label,
                index,
                list(map(float, range(len(names)))),
                [frame.values.get("psnr", math.nan) for frame in run.per_frame[set_name]],
            )
            for index, run in enumerate(runs)
        ]
        chart = line_chart(lines, "frame", "PSNR [dB]", x_names=names, markers=True)
        if chart:
            figures.append(f"<figure><h4>{_set_title(set_name)}</h4>{chart}</figure>")
    if not figures:
        return ""
    return f'<section><h2>PSNR of each frame</h2>{_legend(runs)}<div class="charts">{"".join(figures)}</div></section>'


# ---------------------------------------------------------------------------------------------------- provenance


def _provenance(runs: Sequence[EvaluatedRun]) -> str:
    parts = ["<section><h2>Provenance</h2>"]
    scenes = _recorded_scenes(runs)
    first = next(iter(scenes.values()), {})
    if all(leaves(scene) == leaves(first) for scene in scenes.values()):
        parts.append(record("Data", first))
    else:
        parts += [record(f"Data of {label}", scene) for label, scene in scenes.items()]
    for run in runs:
        own = {key: value for key, value in run.provenance.items() if key != "scene"}
        # The stamp names the run without saying where this machine keeps it.
        stamp = run.folder.resolve().name
        title = run.label if stamp in run.label else f"{run.label} · {stamp}"
        parts.append(record(title, own))
    return "\n".join([*parts, "</section>"])


# ---------------------------------------------------------------------------------------------------- small parts


def _set_title(set_name: str) -> str:
    return escape(_SET_TITLES.get(set_name, set_name))


def _count(number: int, noun: str) -> str:
    return f'<span class="count">{number} {noun}{"" if number == 1 else "s"}</span>'


def _swatch(style: int) -> str:
    return f'<i class="swatch {style_classes(style)}"></i>'


def _legend(runs: Sequence[EvaluatedRun]) -> str:
    items = "".join(f"<li>{_swatch(index)}{escape(run.label)}</li>" for index, run in enumerate(runs))
    return f'<ul class="legend">{items}</ul>'
