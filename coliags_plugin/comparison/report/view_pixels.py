"""Frames of held-out views that a report shows, and their pixels from the run folders, reduced to its size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

from coliags_plugin.comparison.report.metric_columns import metric_title
from coliags_plugin.comparison.report.study import Part, Study, StudyRun
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.outputs.colormaps import depth_error, rgb_error
from coliags_plugin.outputs.image_files import read_depth_tiff

#: Wider images are reduced by an integer factor, to limit the size of the report, px.
_WIDEST = 640

Rgb = UInt8[np.ndarray, "H W 3"]
Map = Float[np.ndarray, "H W"]
#: Metrics whose worst frame is shown as well.
_WORST_OF = ("psnr", "depth_mse")


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
