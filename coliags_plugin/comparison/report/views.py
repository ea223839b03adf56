"""Held-out views: a slider between two methods, and every method beside the truth, with errors on one scale."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from coliags_plugin.comparison.report.metric_tables import metric_title
from coliags_plugin.comparison.report.study import Part, Study, StudyRun
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.reporting.colormaps import (
    colorize_depth,
    colorize_error,
    common_limits,
    depth_error,
    hatch,
    rgb_error,
)
from coliags_plugin.reporting.image_files import encode_jpeg, encode_webp, read_depth_tiff
from coliags_plugin.reporting.model import ColorBar, EncodedImage, Paragraph, Section, Template
from coliags_plugin.reporting.numbers import column_decimals, linear_ticks, number_text, round_up, unit_text

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
class _Frame:
    """A frame to show."""

    part: Part
    scene: str
    position: int  # its index among the frames of the set
    name: str
    why: str  # why it is shown; empty for one of those spread along the video

    def values(self, run: StudyRun) -> dict[str, float]:
        """Metrics of one run."""
        values = {name: own[self.position] for name, own in run.result.sets[self.part.set_name].values.items()}
        return {name: value for name, value in values.items() if value is not None}


def _choose_frames(study: Study, reference: str, count: int) -> Iterator[_Frame]:
    """Frames of every scene and set: ``count`` spread evenly, first and last included, and the reference's worst."""
    for scene in study.scenes:
        for part in (part for part in study.parts if scene in part.scenes):
            names, worst_by = part.frames(scene), dict[int, list[str]]()
            for metric in _WORST_OF:
                values = part.frame_means(scene, reference, metric)
                if len(values) > 1:
                    sign = 1.0 if study.metrics[metric].direction == "higher" else -1.0
                    worst = min(values, key=lambda frame: sign * values[frame])
                    worst_by.setdefault(names.index(worst), []).append(metric_title(metric))
            for position in sorted({*evenly(len(names), count), *worst_by}):
                why = f"worst {' and '.join(worst_by[position])} of {reference}" if position in worst_by else ""
                yield _Frame(part, scene, position, names[position], why)


def evenly(length: int, count: int) -> list[int]:
    """``count`` evenly spaced indices below ``length``, first and last included; the middle one if ``count`` is 1."""
    if count >= length:
        return list(range(length))
    if count == 1:
        return [length // 2]
    return [round(index * (length - 1) / (count - 1)) for index in range(count)]


@dataclass(frozen=True)
class _View:
    """A frame and its renderings: one render, error and expected depth per run.

    Errors are absolute: of depth, mm, NaN where the truth is unknown, and None where there is none to compare; of
    colours, levels of 255, where no run has depth to compare.
    """

    frame: _Frame
    runs: Sequence[StudyRun]  # one run of every method
    truth: Rgb
    true_depth: Map | None  # mm, NaN where unknown; None where the frame has none
    renders: Sequence[Rgb]
    errors: Sequence[Map | None]
    of_depth: bool
    expected: Sequence[Map | None]  # NaN where nearly transparent; None where there is none

    @property
    def in_row(self) -> bool:
        """Tell whether all images are in one row: of one method, without true depth."""
        return len(self.runs) == 1 and self.true_depth is None


def _read_view(frame: _Frame, runs: Sequence[StudyRun]) -> _View:
    """Read a frame of one or more runs of one scene, each with a run folder."""
    truth = _read(runs[0], "truth", frame)
    factor = _reduction(truth.shape[1])

    def depths(kind: str) -> list[Map | None]:
        whole = (_read(run, kind, frame, truth, is_depth=True) for run in runs)
        return [None if depth is None else _reduced_map(depth, factor) for depth in whole]

    small_truth = _reduced_rgb(truth, factor)
    renders = [_reduced_rgb(_read(run, "renders", frame, truth), factor) for run in runs]
    true_depth = next((depth for depth in depths("true_depth") if depth is not None), None)
    errors: list[Map | None] = []
    if true_depth is not None:
        errors = [None if depth is None else _depth_error(depth, true_depth) for depth in depths("depth")]
    of_depth = any(error is not None for error in errors)
    if not of_depth:
        errors = [(rgb_error(render, small_truth)[0] * 255.0).astype(np.float32) for render in renders]
    return _View(frame, runs, small_truth, true_depth, renders, errors, of_depth, depths("expected_depth"))


def _read(run: StudyRun, kind: str, frame: _Frame, like: Rgb | None = None, is_depth: bool = False) -> Any:
    """An image of a run, of the size of the true one; None for depth that is not there."""
    reader, suffix = (read_depth_tiff, ".tiff") if is_depth else (read_rgb, ".png")
    assert run.evaluation is not None
    path = run.evaluation / kind / frame.part.set_name / f"{frame.name}{suffix}"
    if not path.is_file():
        if is_depth:
            return None
        raise InputError(
            f"{path} is missing, though the results file lists its frame",
            "a complete evaluation",
            f"Run `coliags eval {run.run} --protocol {run.result.protocol.name}` again",
        )
    pixels = reader(path)
    if like is not None and pixels.shape[:2] != like.shape[:2]:
        height, width = like.shape[:2]
        raise InputError(f"{path} is {pixels.shape[1]} x {pixels.shape[0]} px", f"{width} x {height} px, as the truth")
    return pixels


def _depth_error(depth: Map, truth: Map) -> Map:
    error, known = depth_error(depth, truth)
    return np.where(known, error, np.nan).astype(np.float32)


def _reduction(width: int) -> int:
    """Integer factor by which images of a width are reduced."""
    return math.ceil(width / _WIDEST)


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


def view_section(study: Study, reference: str, count: int) -> Section:
    """Section of held-out views, which can be sorted by the reference's metrics; says so where there are no images."""
    if count < 1:
        raise InputError(f"{count} frames to show", "at least one")
    title, views = "Held-out views", list[_View]()
    for frame in _choose_frames(study, reference, count):
        seeds = ([run for run in frame.part.runs(frame.scene, method) if run.run] for method in study.methods)
        if runs := [with_images[0] for with_images in seeds if with_images]:
            views.append(_read_view(frame, runs))
    if not views:
        text = "No images: only results files are here, without the run folders."
        return Section(title, [Paragraph(text)], screen_only=True)
    ends = {
        of_depth: error_limit([error for view in own for error in view.errors if error is not None])
        for of_depth in (True, False)
        if (own := [view for view in views if view.of_depth is of_depth])
    }
    expected = [depth for view in views for depth in view.expected if depth is not None]
    depth_range = _depth_limits(view.true_depth for view in views if view.true_depth is not None)
    if depth_range is None and expected:
        depth_range = common_limits(expected)
    bars, unit = [], study.length_unit
    if True in ends:
        bars.append(ColorBar((0.0, ends[True]), unit, "error", "|depth error|", "error-scale"))
    if False in ends:
        bars.append(ColorBar((0.0, ends[False]), "levels of 255", "error", "|colour error|", "colour-error-scale"))
    if depth_range is not None:
        bars.append(ColorBar(depth_range, unit, "depth", "depth", "depth-scale"))
    scenes = [
        (
            scene,
            [
                (part.title, [_shown(view, ends, depth_range, reference) for view in same])
                for part, same in groupby(in_scene, attrgetter("frame.part"))
            ],
        )
        for scene, in_scene in groupby(views, attrgetter("frame.scene"))
    ]
    values = {
        "bars": bars,
        "hatch": None if depth_range is None else _webp(hatch(14, 34)),
        "reference": reference,
        "orders": {name: metric_title(name) for name in _SORTED_BY if name in study.metrics},
        "scenes": scenes,
    }
    explanation = Paragraph(_explanation(study, views, reference))
    return Section(title, [explanation, Template("views.html", values)], screen_only=True, name="views")


def _explanation(study: Study, views: Sequence[_View], reference: str) -> str:
    factor = max(_reduction(view.runs[0].result.scene.size[0]) for view in views)
    place = "Beside" if all(view.in_row for view in views) else "Below"
    texts = {
        f"Frames spread along each video, and the worst of {reference}.": True,
        "Under each rendering, its absolute depth error.": any(view.of_depth for view in views),
        "Views without true depth show the absolute colour error, the mean of red, green and blue.": not all(
            view.of_depth for view in views
        ),
        f"{place} it the expected depth, hatched where alpha is below 0.5.": any(
            depth is not None for view in views for depth in view.expected
        ),
        "One scale serves every method, frame and scene of this page; it ends at the smallest 1, 2 or 5 times a power "
        f"of ten below which {_SCALE_PERCENTILE:.0f} % of all errors shown lie. Errors beyond it, and missing depth "
        "where the truth has one, take its last colour.": True,
        f"Images are shown at 1/{factor} of their size.": factor > 1,
        "Of several seeds, the first is shown.": len({run.result.seed for run in study.runs}) > 1,
        "Photographs are JPEG here; the run folders keep them as PNG.": True,
    }
    return " ".join(text for text, is_true in texts.items() if is_true)


def _shown(
    view: _View, ends: dict[bool, float], depth_range: tuple[float, float] | None, reference: str
) -> dict[str, Any]:
    """Values of a view for the template.

    The script sorts by ``data``: the position along the video, and for each metric a number that is larger the worse
    the reference is.
    """
    frame, where = view.frame, f"frame {view.frame.name}"
    study = frame.part.study
    own = frame.part.runs(frame.scene, reference)
    values = frame.values(own[0]) if own else {}
    signs = {name: -1.0 if study.metrics[name].direction == "higher" else 1.0 for name in values}
    truth = _jpeg(view.truth)
    tiles: list[_Tile] = [(truth, f"{where}, true image")]
    caption = []
    if view.true_depth is not None and depth_range is not None:
        tiles.append((_webp(colorize_depth(view.true_depth, depth_range)), f"{where}, true depth"))
        caption = ["above: camera image", "below: true depth"]
    elif not view.in_row:
        tiles.append((None, "no true depth"))
    cells: list[tuple[str, int | None, list[_Tile], list[str]]] = [("truth", None, tiles, caption)]
    kind = "depth" if view.of_depth else "colour"
    for run, render, error, expected in zip(view.runs, view.renders, view.errors, view.expected, strict=True):
        name = run.method
        tiles = [(_jpeg(render), f"{where}, rendered by {name}")]
        if error is None:
            tiles.append((None, "no depth to compare"))
        else:
            drawn = colorize_error(error, ~np.isnan(error), ends[view.of_depth])
            tiles.append((_webp(drawn), f"{where}, absolute {kind} error of {name}"))
            if expected is not None and depth_range is not None:
                drawn = colorize_depth(expected, depth_range, hatched=True)
                tiles.append((_webp(drawn), f"{where}, expected depth of {name}"))
        cells.append((name, study.methods.index(name), tiles, _caption(frame, run)))
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
        "in_row": view.in_row,
        "cells": cells,
    }


def _caption(frame: _Frame, run: StudyRun) -> list[str]:
    values, texts = frame.values(run), []
    shown = [name for name in _CAPTION_METRICS if name in values]
    if "depth_mae" in shown and "depth_mse" in shown:
        shown.remove("depth_mse")
    for name in shown:
        unit = frame.part.study.metrics[name].unit
        number = number_text(values[name], column_decimals(unit, [values[name]]))
        texts.append(f"{metric_title(name)} {number} {unit_text(unit)}".rstrip())
    return texts or ["no metrics for this frame"]


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
