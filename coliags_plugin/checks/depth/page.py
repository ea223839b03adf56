"""Page of the comparison of depth: errors, the calibration of the confidence, and frames; and maps of the error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from coliags_plugin.checks.depth.check import DepthCheck
from coliags_plugin.checks.depth.measures import SURE, DepthErrors, DepthStatistics
from coliags_plugin.checks.depth.pairing import true_depth_at
from coliags_plugin.checks.depth.sources import FrameDepth, known_depth
from coliags_plugin.core.files import atomic_folder
from coliags_plugin.outputs import colormaps
from coliags_plugin.outputs.axis_ticks import round_up
from coliags_plugin.outputs.charts import Series
from coliags_plugin.outputs.image_files import write_png
from coliags_plugin.reporting import model
from coliags_plugin.reporting.numbers import short_number

#: Number of frames shown.
_SHOWN = 4
#: Smallest width of a colour bar with legible ticks, px.
_BAR_WIDTH = 320
#: Smallest full scale of the error, units of the truth.
_SMALLEST_LIMIT = 0.01


def depth_page(check: DepthCheck) -> model.Page:
    """All results of a comparison; in the terminal without single frames."""
    kinds = (("dense true depth", check.dense), ("single points of true depth", check.sparse))
    sections = [
        model.Section(f"Against {kind}", _statistics(check, statistics))
        for kind, statistics in kinds
        if statistics is not None
    ]
    errors = [[frame.name, *_cells(errors)] for frame in check.frames if (errors := frame.dense or frame.sparse)]
    sections += [
        model.Section("Frames", [] if check.dense is None else list(_frames(check)), screen_only=True),
        model.Section("Every frame", [model.simple_table(["frame", *_head(check)], errors)], screen_only=True),
    ]
    return model.Page(f"{check.estimate.path.name}: depth check", sections, list(_facts(check)))


def _facts(check: DepthCheck) -> Iterator[model.Fact]:
    sides = zip(("estimate", "truth"), check.pairs.left_out, strict=True)
    left_out = ", ".join(f"{count} of the {name}" for name, count in sides if count)
    matched = f"{len(check.frames)}, matched by {check.pairs.by}"
    yield model.Fact("estimate", check.estimate.path.name)
    yield model.Fact("truth", check.truth.path.name)
    yield model.Fact("frames", f"{matched}; without a partner: {left_out}" if left_out else matched)
    if check.scale is None:
        yield model.Fact("scale", "as given")
    else:
        factor = f"the estimate times {check.scale:.4g}, the median of true / estimated depth"
        yield model.Fact("scale", f"aligned: {factor}")
    errors = [(errors.median, frame.name) for frame in check.frames if (errors := frame.dense or frame.sparse)]
    medians = sorted((median, name) for median, name in errors if median is not None)
    if medians:
        (least, best), (middle, _), (most, worst) = medians[0], medians[len(medians) // 2], medians[-1]
        ends = f"median |dz|/z {least:.2%} ({best}) to {most:.2%} ({worst})"
        yield model.Fact("by frame", f"{ends}, {middle:.2%} in the median frame")


def _statistics(check: DepthCheck, statistics: DepthStatistics) -> list[model.Block]:
    """Errors over all pixels and by distance, and the confidence's calibration where there is one."""
    rows = [["all", *_cells(statistics.errors)]]
    if statistics.sure is not None:
        rows.append([f"confidence {SURE:g} or more", *_cells(statistics.sure)])
    rows += [[f"{band.low:g} to {band.high:g} {_unit(check)}", *_cells(band.errors)] for band in statistics.bands]
    blocks: list[model.Block] = [model.simple_table(["true depth", *_head(check)], rows)]
    if statistics.bins:
        blocks.append(model.Section("Confidence", _confidence(statistics)))
    return blocks


def _confidence(statistics: DepthStatistics) -> list[model.Block]:
    """Stated and observed share of good pixels by confidence."""
    error = statistics.calibration_error
    rows = [
        [
            "0 (unknown)" if entry.high == 0.0 else f"{entry.low:g} to {entry.high:g}",
            entry.pixels,
            short_number(entry.stated, 100.0),
            short_number(entry.observed, 100.0),
        ]
        for entry in statistics.bins
    ]
    bins = [entry for entry in statistics.bins if entry.high > 0.0]
    stated, observed = [100.0 * entry.stated for entry in bins], [100.0 * entry.observed for entry in bins]
    series = [Series("observed", 0, stated, observed), Series("calibrated", 1, [0.0, 100.0], [0.0, 100.0])]
    axes = "stated confidence, %", "within 5 %, % of the pixels"
    return [
        model.Paragraph(
            "no pixel has a confidence above 0"
            if error is None
            else f"expected calibration error {100.0 * error:.3g} %"
        ),
        model.simple_table(["confidence", "pixels", "stated, %", "observed within 5 %, %"], rows),
        model.Figures([model.Chart(series, *axes, markers=True, legend=True)]),
    ]


def _head(check: DepthCheck) -> list[str]:
    shares = ["coverage, %", "median |dz|/z, %", "90th percentile, %", "within 5 %, %", "bias, %"]
    return ["pixels", *shares, f"median |dz|, {_unit(check)}"]


def _cells(errors: DepthErrors) -> list[str | int | None]:
    shares = [short_number(share, 100.0) for share in (errors.coverage, errors.median, errors.p90, errors.within)]
    return [errors.pixels, *shares, short_number(errors.bias, 100.0, "+"), short_number(errors.median_length)]


def _unit(check: DepthCheck) -> str:
    return "mm" if check.truth.metric else "units"


def _frames(check: DepthCheck) -> Iterator[model.Block]:
    limit = error_limit(check)
    yield model.Paragraph("Errors are hatched where the truth is unknown, and grey where there is no estimate.")
    yield model.Figures([model.ColorBar((0.0, limit), _unit(check), "error", "|dz|", "depth-error")])
    for index in np.unique(np.linspace(0, len(check.pairs.indices) - 1, _SHOWN).astype(int)):
        here, there = check.pairs.indices[index]
        images = _frame_images(check, check.estimate.read(here), check.truth.read(there), limit)
        if images:
            figures = [model.Image(model.EncodedImage.png(rgb), caption) for caption, rgb in images.items()]
            yield model.Figures(figures, check.estimate.names[here])


def _frame_images(
    check: DepthCheck, estimate: FrameDepth, truth: FrameDepth, limit: float
) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
    """Pictures of a frame by their captions; none where the truth has no dense depth."""
    true, error = true_depth_at(estimate, truth), error_map(check, estimate, truth, limit)
    if true is None or error is None or estimate.depth is None:
        return {}
    limits = colormaps.depth_limits([true])
    scaled = estimate.depth * (1.0 if check.scale is None else check.scale)
    images = {} if estimate.image is None else {"image": estimate.image}
    images[f"true, 0 to {limits[1]:g}"] = colormaps.colorize_depth(true, limits)
    images["estimate, same colours"] = colormaps.colorize_depth(scaled, limits)
    images["|dz|"] = error
    if estimate.confidence is not None:
        grey = np.rint(estimate.confidence * 255.0).astype(np.uint8)
        images["confidence, white 1"] = np.repeat(grey[..., None], 3, axis=2)
    return images


def error_limit(check: DepthCheck) -> float:
    """The error of the last colour, the same for all frames, units of the truth: the 90th percentile, rounded up."""
    length = None if check.dense is None else check.dense.errors.p90_length
    return round_up(max(length or 0.0, _SMALLEST_LIMIT))


def error_map(
    check: DepthCheck, estimate: FrameDepth, truth: FrameDepth, limit: float
) -> UInt8[np.ndarray, "H W 3"] | None:
    """|dz| of a frame up to ``limit``: hatched where the truth is unknown, plain grey where there is no estimate.

    At the estimate's size; None where the truth has no dense depth. [H, W, 3]
    """
    true = true_depth_at(estimate, truth)
    if true is None or estimate.depth is None:
        return None
    known, there = np.isfinite(true), known_depth(estimate.depth)
    error: Float[np.ndarray, "H W"] = np.abs(estimate.depth * (1.0 if check.scale is None else check.scale) - true)
    image = colormaps.colorize_error(np.where(there & known, error, 0.0), known, limit)
    image[known & ~there] = colormaps.UNKNOWN_GREY
    return image


def write_error_maps(check: DepthCheck, folder: Path) -> None:
    """Write the error maps as ``NAME.png``, each above its colour bar; ``folder`` must be new or empty."""
    limit = error_limit(check)
    bar = colormaps.color_bar((0.0, limit), f"|dz|, {_unit(check)}", width=_BAR_WIDTH)
    with atomic_folder(folder) as scratch:
        for here, there in check.pairs.indices:
            image = error_map(check, check.estimate.read(here), check.truth.read(there), limit)
            if image is not None:
                write_png(scratch / f"{check.estimate.names[here]}.png", colormaps.stacked([image, bar]))
