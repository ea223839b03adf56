"""Held-out views: a slider between two methods, and every method beside the truth, each set on scales of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.comparison.report.metric_tables import metric_title
from coliags_plugin.comparison.report.study import Study, StudyRun, TestSet, grouped
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.reporting.colormaps import (
    colorize_depth,
    colorize_error,
    depth_error,
    depth_limits,
    error_limit,
    hatch,
    rgb_error,
)
from coliags_plugin.reporting.image_files import EncodedImage, read_depth_tiff
from coliags_plugin.reporting.model import Block, ColorBar, Paragraph, Section, Template
from coliags_plugin.reporting.numbers import column_decimals, number_text, unit_text

#: Wider images are reduced by an integer factor, to limit the size of the report, px.
_WIDEST = 640

Rgb = UInt8[np.ndarray, "H W 3"]
Map = Float[np.ndarray, "H W"]
#: Metrics whose worst frame is shown as well.
_WORST_OF = ("psnr", "depth_mse")
#: Metrics shown under an image, where available; the mean depth error stands for the mean squared one.
_CAPTION_METRICS = ("psnr", "ssim", "depth_mae", "depth_mse")

#: A picture with its alternative text, or what is said instead of one.
_Tile = tuple[EncodedImage | None, str]


@dataclass(frozen=True)
class _Frame:
    """A frame to show."""

    test_set: TestSet
    scene: str
    position: int  # its index among the frames of the set
    name: str
    label: str  # what the page calls it
    why: str  # why it is shown; empty for one of those spread along the video


def _choose_frames(study: Study, reference: str, count: int, label: Callable[[str], str]) -> Iterator[_Frame]:
    """Frames of every scene and set: ``count`` spread evenly, first and last included, and the reference's worst."""
    for scene in study.scenes:
        for test_set in study.test_sets:
            names, worst_by = test_set.frames(scene), dict[int, list[str]]()
            for metric in _WORST_OF:
                values = test_set.frame_means(scene, reference, metric)
                if len(values) > 1:
                    sign = 1.0 if study.metrics[metric].direction == "higher" else -1.0
                    worst = min(values, key=lambda frame: sign * values[frame])
                    worst_by.setdefault(names.index(worst), []).append(metric_title(metric))
            for position in sorted({*evenly(len(names), count), *worst_by}):
                why = f"worst {' and '.join(worst_by[position])} of {reference}" if position in worst_by else ""
                yield _Frame(test_set, scene, position, names[position], label(names[position]), why)


def evenly(length: int, count: int) -> list[int]:
    """``count`` evenly spaced indices below ``length``, first and last included; the middle one if ``count`` is 1."""
    if count == 1:
        return [length // 2]
    return [round(index) for index in np.linspace(0, length - 1, min(count, length)).tolist()]


@dataclass(frozen=True)
class _Rendering:
    """A frame as one run rendered it.

    Its error is absolute: of depth, mm, NaN where the truth is unknown, and None where there is none to compare; of
    colours, levels of 255, where no run has depth to compare.
    """

    run: StudyRun
    rgb: Rgb
    error: Map | None
    expected: Map | None  # expected depth, NaN where nearly transparent; None where there is none


@dataclass(frozen=True)
class _View:
    """A frame and its renderings, one for each run."""

    frame: _Frame
    truth: Rgb
    true_depth: Map | None  # mm, NaN where unknown; None where the frame has none
    renderings: Sequence[_Rendering]  # of one run of every method
    kind: str  # of the errors: depth or colour

    @property
    def in_row(self) -> bool:
        """Tell whether all images are in one row: of one method, without true depth."""
        return len(self.renderings) == 1 and self.true_depth is None


def _read_view(frame: _Frame, runs: Sequence[StudyRun]) -> _View:
    """Read a frame of one or more runs of one scene, each with a run folder."""
    truth = _read(runs[0], "truth", frame)
    renders = [_read(run, "renders", frame) for run in runs]

    def depths(kind: str) -> list[Map | None]:
        return [_read(run, kind, frame) for run in runs]

    true_depth = next((depth for depth in depths("true_depth") if depth is not None), None)
    errors: list[Map | None] = [None]
    if true_depth is not None:
        errors = [None if depth is None else depth_error(depth, true_depth).astype("f4") for depth in depths("depth")]
    kind = "colour" if all(error is None for error in errors) else "depth"
    if kind == "colour":
        errors = [255.0 * rgb_error(render, truth).astype("f4") for render in renders]
    renderings = map(_Rendering, runs, renders, errors, depths("expected_depth"))
    return _View(frame, truth, true_depth, [*renderings], kind)


def _read(run: StudyRun, kind: str, frame: _Frame) -> Any:
    """An image of a run, reduced where it is large; None for depth that is not there."""
    reader, suffix = (read_depth_tiff, ".tiff") if kind.endswith("depth") else (read_rgb, ".png")
    assert run.evaluation is not None
    path = run.evaluation / kind / frame.test_set.set_name / f"{frame.name}{suffix}"
    if not path.is_file():
        if suffix == ".tiff":
            return None
        raise InputError(
            f"{path} is missing, though the results file lists its frame",
            "a complete evaluation",
            f"Run `coliags eval {run.run} --protocol {run.result.protocol.name}` again",
        )
    pixels = reader(path)
    width, height = run.result.scene.size
    if pixels.shape[:2] != (height, width):
        raise InputError(f"{path} is {pixels.shape[1]} x {pixels.shape[0]} px", f"{width} x {height} px, as the others")
    factor = _reduction(width)
    # Averaging across an edge would mix depths of different surfaces.
    interpolation = cv2.INTER_NEAREST_EXACT if suffix == ".tiff" else cv2.INTER_AREA
    return cv2.resize(pixels, (width // factor, height // factor), interpolation=interpolation)


def _reduction(width: int) -> int:
    """Integer factor by which images of a width are reduced."""
    return math.ceil(width / _WIDEST)


def view_section(study: Study, reference: str, count: int, label: Callable[[str], str] = "frame {}".format) -> Section:
    """Section of held-out views; says so where there are no images. ``label`` gives titles to names of frames."""
    if count < 1:
        raise InputError(f"{count} frames to show", "at least one")
    title, views = "Held-out views", list[_View]()
    for frame in _choose_frames(study, reference, count, label):
        seeds = (
            [run for run, _ in frame.test_set.evaluated(method, frame.scene) if run.run] for method in study.methods
        )
        if runs := [with_images[0] for with_images in seeds if with_images]:
            views.append(_read_view(frame, runs))
    if not views:
        text = "No images: only results files are here, without the run folders."
        return Section(title, [Paragraph(text)], screen_only=True)
    in_sets = grouped(views, lambda view: (view.frame.scene, view.frame.test_set))
    values = {"reference": reference, "sets": [_set_values(same, index) for index, same in enumerate(in_sets.values())]}
    factor = max(_reduction(run.result.scene.size[0]) for run in study.runs)
    explanation = (
        f"Frames spread along each video, and the worst of {reference}. Below each rendering is its absolute error, of "
        "depth, or without true depth of colour (the mean of red, green and blue), then its expected depth. The scales "
        "of a set are the same for all its methods and frames: of errors by square roots, of depth logarithmic."
    )
    if len({run.result.seed for run in study.runs}) > 1:
        explanation += " Of several seeds, the first is shown."
    if factor > 1:
        explanation += f" Images are shown at 1/{factor} of their size."
    blocks: list[Block] = [Paragraph(explanation), Template("views.html", values)]
    return Section(title, blocks, screen_only=True, name="views")


def _set_values(views: Sequence[_View], index: int) -> dict[str, Any]:
    """Values of the views of one scene and test set for the template, with the scales that they share.

    The limits of depth are those of the true depths, or of the expected ones where there is no true depth.
    """
    frame, unit = views[0].frame, views[0].frame.test_set.study.length_unit
    ends = {
        kind: error_limit(each.error for view in same for each in view.renderings if each.error is not None)
        for kind, same in grouped(views, lambda view: view.kind).items()
    }
    bars = []
    for kind, end in ends.items():
        of = unit if kind == "depth" else "levels of 255"
        bars.append(ColorBar((0.0, end), of, "error", f"|{kind} error|", f"{kind}-error-scale-{index}"))
    depths = [view.true_depth for view in views if view.true_depth is not None]
    depths = depths or [each.expected for view in views for each in view.renderings if each.expected is not None]
    limits = depth_limits(depths)
    if depths:
        bars.append(ColorBar(limits, unit, "depth", "depth", f"depth-scale-{index}"))
    return {
        "title": f"{frame.scene} · {frame.test_set.title}",
        "bars": bars,
        "hatch": EncodedImage.webp(hatch(14, 34)) if depths else None,
        "views": [_template_values(view, ends[view.kind], limits) for view in views],
    }


def _template_values(view: _View, error_end: float, limits: tuple[float, float]) -> dict[str, Any]:
    """Values of a view for the template."""
    frame, where = view.frame, view.frame.label
    study, test_set = frame.test_set.study, frame.test_set
    truth = EncodedImage.jpeg(view.truth)
    tiles: list[_Tile] = [(truth, f"{where}, true image")]
    caption = []
    if view.true_depth is not None:
        tiles.append((EncodedImage.webp(colorize_depth(view.true_depth, limits)), f"{where}, true depth"))
        caption = ["image and true depth"]
    elif not view.in_row:
        tiles.append((None, "no true depth"))
    cells: list[tuple[str, int | None, list[_Tile], list[str]]] = [("truth", None, tiles, caption)]
    for rendering in view.renderings:
        name = rendering.run.method
        tiles = [(EncodedImage.jpeg(rendering.rgb), f"{where}, rendered by {name}")]
        if rendering.error is None:
            tiles.append((None, "no depth to compare"))
        else:
            drawn = colorize_error(rendering.error, error_end)
            tiles.append((EncodedImage.webp(drawn), f"{where}, absolute {view.kind} error of {name}"))
            if rendering.expected is not None:
                drawn = colorize_depth(rendering.expected, limits, hatched=True)
                tiles.append((EncodedImage.webp(drawn), f"{where}, expected depth of {name}"))
        cells.append((name, study.methods.index(name), tiles, _caption(frame, rendering.run)))
    count = f"{frame.position + 1} of {len(test_set.frames(frame.scene))}"
    return {
        "title": f"{frame.scene} · {test_set.set_name} · {where}",
        "where": where,
        "count": f"{count} · {frame.why}" if frame.why else count,
        "size": truth,
        "in_row": view.in_row,
        "cells": cells,
    }


def _caption(frame: _Frame, run: StudyRun) -> list[str]:
    columns, texts = run.result.sets[frame.test_set.set_name].values, []
    values = {name: column[frame.position] for name, column in columns.items()}
    for name in _CAPTION_METRICS:
        if (value := values.get(name)) is not None and (name != "depth_mse" or values.get("depth_mae") is None):
            unit = frame.test_set.study.metrics[name].unit
            number = number_text(value, column_decimals(unit, [value]))
            texts.append(f"{metric_title(name)} {number} {unit_text(unit)}".rstrip())
    return texts or ["no metrics for this frame"]
