"""The views that a report shows, drawn: images, and errors on one scale for the whole report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coliags_plugin.comparison.report.study import Cell, Study
from coliags_plugin.comparison.report.view_pixels import ViewPixels, read_pixels, reduction
from coliags_plugin.comparison.report.view_selection import ChosenFrame, choose_frames
from coliags_plugin.outputs.axis_ticks import linear_ticks, round_up
from coliags_plugin.outputs.colormaps import (
    colorize_depth,
    colorize_error,
    common_limits,
    depth_error,
    rgb_error,
)
from coliags_plugin.outputs.image_files import encode_jpeg, encode_webp

#: Percentile of the errors shown at which the common scale ends, before rounding up.
SCALE_PERCENTILE = 95.0
_SMALLEST_SCALE = 1e-6
#: Errors of an image that enter the percentile.
_SAMPLED = 20_000

ErrorKind = Literal["depth", "rgb"]


@dataclass(frozen=True)
class EncodedImage:
    """An encoded image.

    Attributes:
        mime: For instance ``image/jpeg``.
        data: The file's bytes.
        width: px.
        height: px.
    """

    mime: str
    data: bytes
    width: int
    height: int


@dataclass(frozen=True)
class MethodView:
    """Rendering, error map and expected depth of one method.

    ``error`` is None where there is no depth to compare, ``depth`` of runs evaluated by a version that had none.
    """

    cell: Cell
    render: EncodedImage
    error: EncodedImage | None
    depth: EncodedImage | None


@dataclass(frozen=True)
class View:
    """One frame: truth, its depth where it has one, and the methods' renderings."""

    frame: ChosenFrame
    error_kind: ErrorKind
    truth: EncodedImage
    depth: EncodedImage | None
    methods: Sequence[MethodView]


@dataclass(frozen=True)
class Scales:
    """Colour scales that all views share.

    Attributes:
        depth_error: Upper end, mm; None where no depth is compared.
        rgb_error: Upper end, levels of 255; None where depth is compared everywhere.
        depth: Range of the true depth, or else of the expected depth, scene units; None without depth.
        expected: Whether expected depth is shown.
        unit: Of depths.
        reduction: Largest integer factor by which images are reduced.
    """

    depth_error: float | None
    rgb_error: float | None
    depth: tuple[float, float] | None
    expected: bool
    unit: str
    reduction: int


@dataclass(frozen=True)
class _ReadView:
    """A frame as read, its errors not coloured yet: NaN where the truth is unknown."""

    frame: ChosenFrame
    error_kind: ErrorKind
    truth: EncodedImage
    true_depth: np.ndarray | None
    cells: Sequence[Cell]
    renders: Sequence[EncodedImage]
    errors: Sequence[np.ndarray | None]
    expected: Sequence[np.ndarray | None]


class Views:
    """Views of a study: read at once, for the common scales; drawn one by one.

    Args:
        study: The results; those without run folders are left out.
        reference: Method whose worst frames are shown.
        count: Evenly spread frames per scene and set.

    Raises:
        InputError: ``count`` is not positive, or an image is missing, damaged or of another size.
    """

    def __init__(self, study: Study, reference: str, count: int) -> None:
        chosen = [(frame, _runs_with_images(study, frame)) for frame in choose_frames(study, reference, count)]
        self._read = [_read_view(frame, runs) for frame, runs in chosen if runs]
        self.scales = Scales(
            depth_error=self._limit("depth"),
            rgb_error=self._limit("rgb"),
            depth=_depth_limits(view.true_depth for view in self._read if view.true_depth is not None)
            or _expected_limits(depth for view in self._read for depth in view.expected if depth is not None),
            expected=any(depth is not None for view in self._read for depth in view.expected),
            unit=_unit(study),
            reduction=max((reduction(view.cells[0].result.scene.size[0]) for view in self._read), default=1),
        )

    @property
    def figures(self) -> int:
        """Number of figures: the truth and every method of each view."""
        return sum(1 + len(view.cells) for view in self._read)

    def drawn(self) -> Iterable[View]:
        """The views in the order of scenes, sets and video."""
        return map(self._draw, self._read)

    def _limit(self, kind: ErrorKind) -> float | None:
        views = [view for view in self._read if view.error_kind == kind]
        return error_limit([error for view in views for error in view.errors if error is not None]) if views else None

    def _draw(self, view: _ReadView) -> View:
        limit = self.scales.depth_error if view.error_kind == "depth" else self.scales.rgb_error
        errors = [
            None if error is None else _webp(colorize_error(error, ~np.isnan(error), limit or 1.0))
            for error in view.errors
        ]
        scale = self.scales.depth
        depths = [
            None if depth is None or scale is None else _webp(colorize_depth(depth, scale, hatched=True))
            for depth in view.expected
        ]
        methods = [MethodView(*each) for each in zip(view.cells, view.renders, errors, depths, strict=True)]
        depth = None
        if view.true_depth is not None and self.scales.depth is not None:
            depth = _webp(colorize_depth(view.true_depth, self.scales.depth))
        return View(view.frame, view.error_kind, view.truth, depth, methods)


def _read_view(frame: ChosenFrame, runs: Sequence[Cell]) -> _ReadView:
    pixels = read_pixels(frame, runs)
    kind: ErrorKind = "depth" if any(depth is not None for depth in pixels.depths) else "rgb"
    return _ReadView(
        frame=frame,
        error_kind=kind,
        truth=_jpeg(pixels.truth),
        true_depth=pixels.true_depth,
        cells=runs,
        renders=[_jpeg(render) for render in pixels.renders],
        errors=_depth_errors(pixels) if kind == "depth" else _rgb_errors(pixels),
        expected=pixels.expected,
    )


def _depth_errors(pixels: ViewPixels) -> list[np.ndarray | None]:
    """Absolute errors, mm."""
    errors: list[np.ndarray | None] = []
    for depth in pixels.depths:
        if depth is None or pixels.true_depth is None:
            errors.append(None)
            continue
        error, known = depth_error(depth, pixels.true_depth)
        errors.append(np.where(known, error, np.nan).astype(np.float32))
    return errors


def _rgb_errors(pixels: ViewPixels) -> list[np.ndarray | None]:
    """Absolute errors, levels of 255."""
    return [(rgb_error(render, pixels.truth) * 255.0).astype(np.float32) for render in pixels.renders]


def _runs_with_images(study: Study, frame: ChosenFrame) -> list[Cell]:
    """One run of every method: that of the first seed with images."""
    by_method = ([cell for cell in study.runs(frame.part, frame.scene, m) if cell.run] for m in study.methods)
    return [runs[0] for runs in by_method if runs]


def error_limit(errors: Sequence[np.ndarray]) -> float:
    """The 95th percentile of all finite errors together, rounded up to 1, 2 or 5 times a power of ten."""
    pooled = np.concatenate([_sampled(values.ravel()) for values in errors]) if errors else np.zeros(0)
    finite = pooled[np.isfinite(pooled)]
    return round_up(max(float(np.percentile(finite, SCALE_PERCENTILE)), _SMALLEST_SCALE)) if finite.size else 1.0


def _sampled(values: np.ndarray) -> np.ndarray:
    return values[:: math.ceil(values.size / _SAMPLED) or 1]


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


def _expected_limits(depths: Iterable[np.ndarray]) -> tuple[float, float] | None:
    found = [*depths]
    return common_limits(found) if found else None


def _unit(study: Study) -> str:
    """Unit of depths: that of the metrics that are lengths."""
    units = {metric.unit for metric in study.metrics.values()}
    return "units" if any(unit.startswith("units") for unit in units) else "mm"


def _jpeg(rgb: np.ndarray) -> EncodedImage:
    return EncodedImage("image/jpeg", encode_jpeg(rgb), rgb.shape[1], rgb.shape[0])


def _webp(rgb: np.ndarray) -> EncodedImage:
    return EncodedImage("image/webp", encode_webp(rgb), rgb.shape[1], rgb.shape[0])
