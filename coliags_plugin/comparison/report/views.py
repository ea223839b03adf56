"""Held-out views: a slider between two methods, and every method beside the truth, with errors on one scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from coliags_plugin.comparison.report.metric_tables import metric_title
from coliags_plugin.comparison.report.study import Part, Study, StudyRun
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.outputs.axis_ticks import linear_ticks, round_up
from coliags_plugin.outputs.colormaps import (
    colorize_depth,
    colorize_error,
    common_limits,
    depth_error,
    hatch,
    rgb_error,
)
from coliags_plugin.outputs.image_files import encode_jpeg, encode_webp, read_depth_tiff
from coliags_plugin.reporting.model import ColorBar, EncodedImage, Paragraph, Section, Template
from coliags_plugin.reporting.numbers import column_decimals, number_text, unit_text

#: Wider images are reduced by an integer factor, to limit the size of the report, px.
_WIDEST = 640

Rgb = UInt8[np.ndarray, "H W 3"]
Map = Float[np.ndarray, "H W"]
#: Metrics whose worst frame is shown as well.
_WORST_OF = ("psnr", "depth_mse")
#: Percentile of the errors shown at which the common scale ends, before rounding up.
_SCALE_PERCENTILE = 95.0
_SMALLEST_SCALE = 1e-6
#: Errors of an image that enter the percentile.
_SAMPLED = 20_000
#: Metrics shown under an image, where available.
_CAPTION_METRICS = ("psnr", "psnr_seen", "ssim", "ssim_seen", "depth_mae", "depth_mae_seen", "depth_mse")
#: Metrics by which views can be sorted.
_SORTED_BY = ("psnr", "ssim", "lpips", "depth_mse", "depth_mse_inner", "depth_median_error")

#: A picture with its alternative text, or what is said instead of one.
_Tile = tuple[EncodedImage | None, str]


@dataclass(frozen=True)
class ChosenFrame:
    """A frame to show."""

    part: Part
    scene: str
    position: int  # its index among the frames of the set
    name: str
    why: str = ""  # why it is shown, where not for being one of those spread along the video


def choose_frames(study: Study, reference: str, count: int) -> list[ChosenFrame]:
    """Frames of every scene and set: ``count`` spread evenly, first and last included, and the reference's worst."""
    if count < 1:
        raise InputError(f"{count} frames to show", "at least one")
    return [
        chosen
        for scene in study.scenes
        for part in study.parts
        if scene in part.scenes
        for chosen in _choose_of_set(part, scene, reference, count)
    ]


def _choose_of_set(part: Part, scene: str, reference: str, count: int) -> list[ChosenFrame]:
    names, worst_by = part.frames(scene), dict[int, list[str]]()
    for metric in _WORST_OF:
        values = part.frame_means(scene, reference, metric)
        if len(values) > 1:
            sign = 1.0 if part.study.metrics[metric].direction == "higher" else -1.0
            worst = min(values, key=lambda frame: sign * values[frame])
            worst_by.setdefault(names.index(worst), []).append(metric_title(metric))
    reasons = {position: f"worst {' and '.join(metrics)} of {reference}" for position, metrics in worst_by.items()}
    return [
        ChosenFrame(part, scene, position, names[position], reasons.get(position, ""))
        for position in sorted({*evenly(len(names), count), *reasons})
    ]


def evenly(length: int, count: int) -> list[int]:
    """``count`` evenly spaced indices below ``length``, first and last included; the middle one if ``count`` is 1."""
    if count >= length:
        return list(range(length))
    if count == 1:
        return [length // 2]
    return [round(index * (length - 1) / (count - 1)) for index in range(count)]


@dataclass(frozen=True)
class ViewPixels:
    """A frame and its renderings: one render, error and expected depth per run.

    Errors are absolute: of depth, mm, NaN where the truth is unknown, and None where there is none to compare; of
    colours, levels of 255, where no run has depth to compare.
    """

    frame: ChosenFrame
    runs: Sequence[StudyRun]  # one run of every method
    truth: Rgb
    true_depth: Map | None  # mm, NaN where unknown; None where the frame has none
    renders: Sequence[Rgb]
    errors: Sequence[Map | None]
    of_depth: bool
    expected: Sequence[Map | None]  # NaN where nearly transparent; None where there is none


def reduction(width: int) -> int:
    """Integer factor by which images of a width are reduced."""
    return math.ceil(width / _WIDEST)


def read_pixels(frame: ChosenFrame, runs: Sequence[StudyRun]) -> ViewPixels:
    """Read a frame of one or more runs of one scene, each with a run folder."""
    truth = _read(read_rgb, runs[0], "truth", frame, ".png")
    shape, factor = truth.shape[:2], reduction(truth.shape[1])

    def depths(kind: str) -> list[Map | None]:
        whole = (_read_depth(run, kind, frame, shape) for run in runs)
        return [None if depth is None else _reduced_map(depth, factor) for depth in whole]

    reduced_truth = _reduced_rgb(truth, factor)
    renders = [_reduced_rgb(_read(read_rgb, run, "renders", frame, ".png", shape), factor) for run in runs]
    true_depth = next((depth for depth in depths("true_depth") if depth is not None), None)
    errors: list[Map | None] = []
    if true_depth is not None:
        errors = [None if depth is None else _depth_error(depth, true_depth) for depth in depths("depth")]
    of_depth = any(error is not None for error in errors)
    if not of_depth:
        errors = [(rgb_error(render, reduced_truth) * 255.0).astype(np.float32) for render in renders]
    expected = depths("expected_depth")
    return ViewPixels(frame, runs, reduced_truth, true_depth, renders, errors, of_depth, expected)


def _depth_error(depth: Map, truth: Map) -> Map:
    error, known = depth_error(depth, truth)
    return np.where(known, error, np.nan).astype(np.float32)


def _path(run: StudyRun, kind: str, frame: ChosenFrame, suffix: str) -> Path:
    if run.evaluation is None:
        raise ValueError(f"{run.method} has no run folder")
    return run.evaluation / kind / frame.part.set_name / f"{frame.name}{suffix}"


def _read(
    reader: Callable[[Path], np.ndarray],
    run: StudyRun,
    kind: str,
    frame: ChosenFrame,
    suffix: str,
    shape: tuple[int, ...] | None = None,
) -> np.ndarray:
    path = _path(run, kind, frame, suffix)
    if not path.is_file():
        raise InputError(
            f"{path} is missing, though the results file lists its frame",
            "a complete evaluation",
            f"Run `coliags eval {run.run} --protocol {run.result.protocol.name}` again",
        )
    pixels = reader(path)
    if shape is not None and pixels.shape[:2] != shape:
        raise InputError(
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} px", f"{shape[1]} x {shape[0]} px, as the true image"
        )
    return pixels


def _read_depth(run: StudyRun, kind: str, frame: ChosenFrame, shape: tuple[int, ...]) -> np.ndarray | None:
    if not _path(run, kind, frame, ".tiff").is_file():
        return None
    return _read(read_depth_tiff, run, kind, frame, ".tiff", shape)


def _reduced_rgb(rgb: Rgb, factor: int) -> Rgb:
    if factor == 1:
        return rgb
    height, width = rgb.shape[0] // factor, rgb.shape[1] // factor
    whole = np.ascontiguousarray(rgb[: height * factor, : width * factor])
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def _reduced_map(values: Shaped[np.ndarray, "H W"], factor: int) -> Shaped[np.ndarray, "h w"]:
    """Subsampled map: averaging across an edge would mix depths of different surfaces."""
    height, width = values.shape[0] // factor, values.shape[1] // factor
    middle = factor // 2
    return values[middle::factor, middle::factor][:height, :width]


@dataclass(frozen=True)
class _Scales:
    """Colour scales that all views share."""

    depth_error: float | None  # upper end, mm; None where no depth is compared
    rgb_error: float | None  # upper end, levels of 255; None where depth is compared everywhere
    depth: tuple[float, float] | None  # range of the true, or else the expected depth, scene units
    unit: str

    @property
    def bars(self) -> list[ColorBar]:
        """The scales with names."""
        bars = []
        if self.depth_error is not None:
            bars.append(ColorBar((0.0, self.depth_error), self.unit, "error", "|depth error|", "error-scale"))
        if self.rgb_error is not None:
            limits = (0.0, self.rgb_error)
            bars.append(ColorBar(limits, "levels of 255", "error", "|colour error|", "colour-error-scale"))
        if self.depth is not None:
            bars.append(ColorBar(self.depth, self.unit, "depth", "depth", "depth-scale"))
        return bars


def view_section(study: Study, reference: str, count: int) -> Section:
    """Section of held-out views, which can be sorted by the reference's metrics; says so where there are no images."""
    title = "Held-out views"
    chosen = [(frame, _runs_with_images(study, frame)) for frame in choose_frames(study, reference, count)]
    views = [read_pixels(frame, runs) for frame, runs in chosen if runs]
    if not views:
        text = "No images: only results files are here, without the run folders."
        return Section(title, [Paragraph(text)], screen_only=True)
    expected = [depth for view in views for depth in view.expected if depth is not None]
    scales = _Scales(
        depth_error=_scale_end([view for view in views if view.of_depth]),
        rgb_error=_scale_end([view for view in views if not view.of_depth]),
        depth=_depth_limits(view.true_depth for view in views if view.true_depth is not None)
        or (common_limits(expected) if expected else None),
        unit=study.length_unit,
    )
    scenes = [
        (
            scene,
            [
                (part.title, [_view(view, scales, reference) for view in same])
                for part, same in groupby(own, attrgetter("frame.part"))
            ],
        )
        for scene, own in groupby(views, attrgetter("frame.scene"))
    ]
    values = {
        "bars": scales.bars,
        "hatch": _webp(hatch(14, 34)) if scales.depth is not None else None,
        "reference": reference,
        "orders": {name: metric_title(name) for name in _SORTED_BY if name in study.metrics},
        "scenes": scenes,
    }
    explanation = Paragraph(_explanation(study, views, scales, reference))
    return Section(title, [explanation, Template("views.html", values)], screen_only=True, name="views")


def _runs_with_images(study: Study, frame: ChosenFrame) -> list[StudyRun]:
    """One run of every method: that of the first seed with images."""
    by_method = ([run for run in frame.part.runs(frame.scene, method) if run.run] for method in study.methods)
    return [runs[0] for runs in by_method if runs]


def _explanation(study: Study, views: Sequence[ViewPixels], scales: _Scales, reference: str) -> str:
    factor = max(reduction(view.runs[0].result.scene.size[0]) for view in views)
    texts = [f"Frames spread along each video, and the worst of {reference}."]
    if scales.depth_error is not None:
        texts.append("Under each rendering, its absolute depth error.")
    if scales.rgb_error is not None:
        texts.append("Views without true depth show the absolute colour error, the mean of red, green and blue.")
    if any(depth is not None for view in views for depth in view.expected):
        place = "Beside" if all(map(_in_row, views)) else "Below"
        texts.append(f"{place} it the expected depth, hatched where alpha is below 0.5.")
    texts.append(
        "One scale serves every method, frame and scene of this page; it ends at the smallest 1, 2 or 5 times a power "
        f"of ten below which {_SCALE_PERCENTILE:.0f} % of all errors shown lie. Errors beyond it, and missing depth "
        "where the truth has one, take its last colour."
    )
    if factor > 1:
        texts.append(f"Images are shown at 1/{factor} of their size.")
    if len({run.result.seed for run in study.runs}) > 1:
        texts.append("Of several seeds, the first is shown.")
    return " ".join([*texts, "Photographs are JPEG here; the run folders keep them as PNG."])


def _in_row(view: ViewPixels) -> bool:
    """Whether all images of a view are in one row: of one method, without true depth."""
    return len(view.runs) == 1 and view.true_depth is None


def _view(view: ViewPixels, scales: _Scales, reference: str) -> dict[str, Any]:
    """Values of a view for the template.

    The script sorts by ``data``: the position along the video, and for each metric a number that is larger the worse
    the reference is.
    """
    frame, where = view.frame, f"frame {view.frame.name}"
    metrics = frame.part.study.metrics
    runs = frame.part.runs(frame.scene, reference)
    values = _frame_values(frame, runs[0]) if runs else {}
    signs = {name: -1.0 if metrics[name].direction == "higher" else 1.0 for name in values}
    truth = _jpeg(view.truth)
    tiles: list[_Tile] = [(truth, f"{where}, true image")]
    if view.true_depth is not None and scales.depth is not None:
        tiles.append((_webp(colorize_depth(view.true_depth, scales.depth)), f"{where}, true depth"))
        caption = ["above: camera image", "below: true depth"]
    else:
        caption = []
        if not _in_row(view):
            tiles.append((None, "no true depth"))
    return {
        "title": f"{frame.scene} · {frame.part.set_name} · {frame.name}",
        "where": where,
        "count": f"{frame.position + 1} of {len(frame.part.frames(frame.scene))}"
        + (f" · {frame.why}" if frame.why else ""),
        "data": {
            "position": frame.position,
            **{name.replace("_", "-"): signs[name] * values[name] for name in _SORTED_BY if name in values},
        },
        "size": truth,
        "in_row": _in_row(view),
        "cells": [("truth", None, tiles, caption), *_method_cells(view, scales, where)],
    }


def _method_cells(
    view: ViewPixels, scales: _Scales, where: str
) -> Iterable[tuple[str, int | None, list[_Tile], list[str]]]:
    """Name, style, pictures and caption of every method."""
    limit = (scales.depth_error if view.of_depth else scales.rgb_error) or 1.0
    kind = "depth" if view.of_depth else "colour"
    for run, render, error, expected in zip(view.runs, view.renders, view.errors, view.expected, strict=True):
        name = run.method
        tiles: list[_Tile] = [(_jpeg(render), f"{where}, rendered by {name}")]
        if error is None:
            tiles.append((None, "no depth to compare"))
        else:
            drawn = _webp(colorize_error(error, ~np.isnan(error), limit))
            tiles.append((drawn, f"{where}, absolute {kind} error of {name}"))
            if expected is not None and scales.depth is not None:
                drawn = _webp(colorize_depth(expected, scales.depth, hatched=True))
                tiles.append((drawn, f"{where}, expected depth of {name}"))
        yield name, view.frame.part.study.methods.index(name), tiles, _caption(view.frame, run)


def _caption(frame: ChosenFrame, run: StudyRun) -> list[str]:
    values, metrics = _frame_values(frame, run), frame.part.study.metrics
    shown = [name for name in _CAPTION_METRICS if name in values]
    if "depth_mae" in shown and "depth_mse" in shown:
        shown.remove("depth_mse")
    texts = []
    for name in shown:
        unit = metrics[name].unit
        number = number_text(values[name], column_decimals(unit, [values[name]]))
        texts.append(f"{metric_title(name)} {number} {unit_text(unit)}".rstrip())
    return texts or ["no metrics for this frame"]


def _frame_values(frame: ChosenFrame, run: StudyRun) -> dict[str, float]:
    """Metrics of a frame of one run."""
    record = frame.part.record(run)
    values = {} if record is None else {name: own[frame.position] for name, own in record.values.items()}
    return {name: value for name, value in values.items() if value is not None}


def _scale_end(views: Sequence[ViewPixels]) -> float | None:
    return error_limit([error for view in views for error in view.errors if error is not None]) if views else None


def error_limit(errors: Sequence[np.ndarray]) -> float:
    """The 95th percentile of all finite errors together, rounded up to 1, 2 or 5 times a power of ten."""
    samples = [values.ravel()[:: math.ceil(values.size / _SAMPLED) or 1] for values in errors]
    pooled = np.concatenate(samples) if samples else np.zeros(0)
    finite = pooled[np.isfinite(pooled)]
    return round_up(max(float(np.percentile(finite, _SCALE_PERCENTILE)), _SMALLEST_SCALE)) if finite.size else 1.0


def _depth_limits(depths: Iterable[np.ndarray]) -> tuple[float, float] | None:
    """Range of the depths shown, widened to the next ticks."""
    finite = [own for depth in depths if (own := depth[np.isfinite(depth)]).size]
    if not finite:
        return None
    low, high = min(float(own.min()) for own in finite), max(float(own.max()) for own in finite)
    if low == high:
        low, high = low - 0.5, high + 0.5
    ticks = linear_ticks(low, high)
    step = ticks[1] - ticks[0] if len(ticks) > 1 else round_up(high - low)
    return math.floor(low / step) * step, math.ceil(high / step) * step


def _jpeg(rgb: np.ndarray) -> EncodedImage:
    return EncodedImage(encode_jpeg(rgb), "image/jpeg", rgb.shape[1], rgb.shape[0])


def _webp(rgb: np.ndarray) -> EncodedImage:
    return EncodedImage(encode_webp(rgb), "image/webp", rgb.shape[1], rgb.shape[0])
