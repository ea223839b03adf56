"""Held-out views of a report: selection, reading, and error maps on a common colour scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.outputs.axis_ticks import linear_ticks, round_up
from coliags_plugin.outputs.colormaps import (
    colorize_depth,
    colorize_depth_error,
    colorize_rgb_error,
    depth_error,
    rgb_error,
)
from coliags_plugin.outputs.image_files import encode_jpeg, encode_png, read_depth_tiff, read_rgb
from coliags_plugin.reporting.run_data import EvaluatedRun, FrameMetrics

#: Wider images are reduced by an integer factor, to limit the size of the report, px.
_WIDEST = 640
#: Percentile of the errors shown at which the common scale ends, before rounding up.
SCALE_PERCENTILE = 95.0
_SMALLEST_SCALE = 1e-6


@dataclass(frozen=True)
class EncodedImage:
    """An encoded image.

    Attributes:
        mime: ``image/png`` or ``image/jpeg``.
        data: The file's bytes.
        width: px.
        height: px.
    """

    mime: str
    data: bytes
    width: int
    height: int


@dataclass(frozen=True)
class RunView:
    """Rendering, error map and metrics of one run; ``error`` is None if the run has no depth of the frame."""

    render: EncodedImage
    error: EncodedImage | None
    metrics: FrameMetrics


@dataclass(frozen=True)
class View:
    """One held-out frame: ground truth and every run's rendering; ``depth`` is None if the data have none."""

    set_name: str
    frame: str
    position: int
    frames_in_set: int
    truth: EncodedImage
    depth: EncodedImage | None
    runs: Sequence[RunView]


@dataclass(frozen=True)
class Views:
    """The views of a report and the scales they share.

    Attributes:
        views: In the order of the sets and the video.
        size: Width and height of the evaluated images, px.
        reduction: Integer factor by which the images are reduced.
        error_kind: Whether the error maps show depth or colour errors.
        error_limit: Upper end of the common error scale: mm for depth, levels of 255 for colour.
        depth_limits: Range of the common scale of the true depth, mm; None without depth.
    """

    views: Sequence[View]
    size: tuple[int, int]
    reduction: int
    error_kind: Literal["depth", "rgb"]
    error_limit: float
    depth_limits: tuple[float, float] | None


@dataclass(frozen=True)
class _Pixels:
    """Pixels of a selected frame, reduced. Depths are in mm."""

    set_name: str
    position: int
    truth: np.ndarray
    true_depth: np.ndarray | None
    renders: list[np.ndarray]
    depths: list[np.ndarray | None]


def read_views(runs: Sequence[EvaluatedRun], count: int) -> Views:
    """Select frames evenly over every test set, first and last included, and draw them.

    Args:
        runs: Runs evaluated on the same frames.
        count: Frames per set; all of a smaller set.

    Raises:
        InputError: ``count`` is not positive; or an image is missing, damaged, or not of the ground truth's size.
    """
    if count < 1:
        raise InputError(f"{count} frames to show", "at least one")
    first = runs[0]
    chosen = [
        (set_name, position) for set_name, frames in first.per_frame.items() for position in evenly(len(frames), count)
    ]
    pixels: list[_Pixels] = []
    size = (0, 0)
    reduction = 1
    for set_name, position in chosen:
        truth = _read(read_rgb, first, "truth", set_name, position, ".png")
        if not pixels:
            size = (truth.shape[1], truth.shape[0])
            reduction = math.ceil(truth.shape[1] / _WIDEST)
        pixels.append(_read_pixels(runs, set_name, position, truth, reduction))
    with_depth = [frame for frame in pixels if frame.true_depth is not None]
    kind: Literal["depth", "rgb"] = "depth" if any(d is not None for f in with_depth for d in f.depths) else "rgb"
    limit = error_limit(_errors(pixels, kind))
    depth_limits = _depth_limits(with_depth)
    return Views(
        views=[_draw(frame, runs, kind, limit, depth_limits) for frame in pixels],
        size=size,
        reduction=reduction,
        error_kind=kind,
        error_limit=limit,
        depth_limits=depth_limits,
    )


def evenly(length: int, count: int) -> list[int]:
    """``count`` evenly spaced indices below ``length``, first and last included; the middle one if ``count`` is 1."""
    if count >= length:
        return list(range(length))
    if count == 1:
        return [length // 2]
    return [round(index * (length - 1) / (count - 1)) for index in range(count)]


def error_limit(errors: Sequence[np.ndarray]) -> float:
    """The 95th percentile of all finite errors together, rounded up to 1, 2 or 5 times a power of ten."""
    pooled = np.concatenate([values.ravel() for values in errors]) if errors else np.zeros(0)
    finite = pooled[np.isfinite(pooled)]
    return round_up(max(float(np.percentile(finite, SCALE_PERCENTILE)), _SMALLEST_SCALE)) if finite.size else 1.0


def _read_pixels(
    runs: Sequence[EvaluatedRun], set_name: str, position: int, truth: np.ndarray, reduction: int
) -> _Pixels:
    shape = truth.shape[:2]
    renders = [_read(read_rgb, run, "renders", set_name, position, ".png", shape) for run in runs]
    truths = (_read_if_there(run, "true_depth", set_name, position, shape) for run in runs)
    true_depth = next((depth for depth in truths if depth is not None), None)
    depths: list[np.ndarray | None] = [None] * len(runs)
    if true_depth is not None:
        depths = [_read_if_there(run, "depth", set_name, position, shape) for run in runs]
    return _Pixels(
        set_name,
        position,
        _reduced_rgb(truth, reduction),
        None if true_depth is None else _reduced_map(true_depth, reduction),
        [_reduced_rgb(render, reduction) for render in renders],
        [None if depth is None else _reduced_map(depth, reduction) for depth in depths],
    )


def _path(run: EvaluatedRun, kind: str, set_name: str, position: int, suffix: str) -> Path:
    return run.evaluation / kind / set_name / f"{run.per_frame[set_name][position].name}{suffix}"


def _read(
    reader: Callable[[Path], np.ndarray],
    run: EvaluatedRun,
    kind: str,
    set_name: str,
    position: int,
    suffix: str,
    shape: tuple[int, ...] | None = None,
) -> np.ndarray:
    path = _path(run, kind, set_name, position, suffix)
    if not path.is_file():
        raise InputError(
            f"{path} is missing, though per_frame.csv lists its frame",
            "a complete evaluation",
            f"Run `coliags eval {run.folder} --protocol {run.evaluation.name} --overwrite` again",
        )
    pixels = reader(path)
    if shape is not None and pixels.shape[:2] != shape:
        raise InputError(
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} px", f"{shape[1]} x {shape[0]} px, as the true image"
        )
    return pixels


def _read_if_there(
    run: EvaluatedRun, kind: str, set_name: str, position: int, shape: tuple[int, ...]
) -> np.ndarray | None:
    if not _path(run, kind, set_name, position, ".tiff").is_file():
        return None
    return _read(read_depth_tiff, run, kind, set_name, position, ".tiff", shape)


def _reduced_rgb(rgb: np.ndarray, reduction: int) -> np.ndarray:
    if reduction == 1:
        return rgb
    height, width = rgb.shape[0] // reduction, rgb.shape[1] // reduction
    whole = np.ascontiguousarray(rgb[: height * reduction, : width * reduction])
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def _reduced_map(values: np.ndarray, reduction: int) -> np.ndarray:
    """Subsampled map: averaging across an edge would mix depths of different surfaces."""
    height, width = values.shape[0] // reduction, values.shape[1] // reduction
    middle = reduction // 2
    return values[middle::reduction, middle::reduction][:height, :width]


def _errors(pixels: Iterable[_Pixels], kind: Literal["depth", "rgb"]) -> list[np.ndarray]:
    errors = []
    for frame in pixels:
        if kind == "rgb":
            errors += [rgb_error(render, frame.truth) * 255.0 for render in frame.renders]
        elif frame.true_depth is not None:
            for depth in frame.depths:
                if depth is not None:
                    error, known = depth_error(depth, frame.true_depth)
                    errors.append(error[known])
    return errors


def _depth_limits(frames: Sequence[_Pixels]) -> tuple[float, float] | None:
    """Range of the true depths shown, widened to the next ticks."""
    finite = [depth[np.isfinite(depth)] for frame in frames if (depth := frame.true_depth) is not None]
    values = np.concatenate(finite) if finite else np.zeros(0)
    if not values.size:
        return None
    low, high = float(values.min()), float(values.max())
    if low == high:
        low, high = low - 0.5, high + 0.5
    ticks = linear_ticks(low, high)
    step = ticks[1] - ticks[0] if len(ticks) > 1 else round_up(high - low)
    return math.floor(low / step) * step, math.ceil(high / step) * step


def _draw(
    frame: _Pixels,
    runs: Sequence[EvaluatedRun],
    kind: Literal["depth", "rgb"],
    limit: float,
    depth_limits: tuple[float, float] | None,
) -> View:
    drawn = []
    for run, render, depth in zip(runs, frame.renders, frame.depths, strict=True):
        error = None
        if kind == "rgb":
            error = _png(colorize_rgb_error(render, frame.truth, limit=limit / 255.0))
        elif depth is not None and frame.true_depth is not None:
            error = _png(colorize_depth_error(depth, frame.true_depth, None, limit))
        drawn.append(RunView(_jpeg(render), error, run.per_frame[frame.set_name][frame.position]))
    in_set = runs[0].per_frame[frame.set_name]
    true_depth = None
    if frame.true_depth is not None and depth_limits is not None:
        true_depth = _png(colorize_depth(frame.true_depth, depth_limits))
    return View(
        frame.set_name, in_set[frame.position].name, frame.position, len(in_set), _jpeg(frame.truth), true_depth, drawn
    )


def _png(rgb: np.ndarray) -> EncodedImage:
    return EncodedImage("image/png", encode_png(rgb), rgb.shape[1], rgb.shape[0])


def _jpeg(rgb: np.ndarray) -> EncodedImage:
    return EncodedImage("image/jpeg", encode_jpeg(rgb), rgb.shape[1], rgb.shape[0])
