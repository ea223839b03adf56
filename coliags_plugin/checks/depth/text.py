"""Text of the comparison of depth, for the terminal and the HTML page."""

from __future__ import annotations

from collections.abc import Iterator

from coliags_plugin.checks.depth.check import DepthCheck
from coliags_plugin.checks.depth.measures import SURE, Errors, Measures
from coliags_plugin.outputs.text_table import aligned

Table = tuple[list[str], list[list[str]]]

#: Cell of an unavailable value.
_NONE = "-"
_KINDS = {"dense": "dense true depth", "sparse": "single points of true depth"}


def fact_rows(check: DepthCheck) -> Iterator[tuple[str, str]]:
    """Names and values of what was compared."""
    left_out = [
        f"{count} of the {name}"
        for name, count in zip(("estimate", "truth"), check.pairs.left_out, strict=True)
        if count
    ]
    yield "estimate", check.estimate.path.name
    yield "truth", check.truth.path.name
    yield (
        "frames",
        f"{len(check.frames)}, matched by {check.pairs.by}"
        + (f"; without a partner: {', '.join(left_out)}" * bool(left_out)),
    )
    yield (
        "scale",
        "as given"
        if check.scale is None
        else f"aligned: the estimate times {check.scale:.4g}, the median of true / estimated depth",
    )


def kinds(check: DepthCheck) -> Iterator[tuple[str, Measures]]:
    """The kinds of truth that there are, and the statistics against them."""
    for name, measures in (("dense", check.dense), ("sparse", check.sparse)):
        if measures is not None:
            yield _KINDS[name], measures


def error_table(check: DepthCheck, measures: Measures) -> Table:
    """Errors over all pixels and by distance."""
    rows = [["all", *_cells(measures.errors)]]
    if measures.sure is not None:
        rows.append([f"confidence {SURE:g} or more", *_cells(measures.sure)])
    rows += [[f"{band.low:g} to {band.high:g} {_short(check)}", *_cells(band.errors)] for band in measures.bands]
    return ["true depth", *_head(check)], rows


def frame_table(check: DepthCheck) -> Table:
    """Errors of every frame, against dense depth where there is some."""
    rows = [[frame.name, *_cells(errors)] for frame in check.frames if (errors := frame.dense or frame.sparse)]
    return ["frame", *_head(check)], rows


def confidence_table(measures: Measures) -> Table | None:
    """Stated and observed share of good pixels by confidence; None where the estimate states none."""
    if not measures.bins:
        return None
    head = ["confidence", "pixels", "stated, %", "observed within 5 %, %"]
    rows = [
        [
            "0 (unknown)" if found.high == 0.0 else f"{found.low:g} to {found.high:g}",
            str(found.pixels),
            _number(found.stated, 100.0),
            _number(found.observed, 100.0),
        ]
        for found in measures.bins
    ]
    return head, rows


def calibration_line(measures: Measures) -> str:
    """The expected calibration error in words."""
    if measures.calibration_error is None:
        return "no pixel has a confidence above 0"
    return f"expected calibration error {100.0 * measures.calibration_error:.3g} %"


def lines(check: DepthCheck) -> Iterator[str]:
    """All results, without single frames, as lines for the terminal."""
    yield from aligned([list(row) for row in fact_rows(check)])
    yield from [f"by frame: {frames}"] if (frames := _frames_line(check)) else []
    for kind, measures in kinds(check):
        yield ""
        yield f"against {kind}"
        head, rows = error_table(check, measures)
        yield from aligned([head, *rows])
        confidence = confidence_table(measures)
        if confidence is not None:
            yield ""
            yield from aligned([confidence[0], *confidence[1]])
            yield calibration_line(measures)


def _frames_line(check: DepthCheck) -> str:
    """Range of the frames' median errors; empty where none has an estimate."""
    found = [(errors.median, frame.name) for frame in check.frames if (errors := frame.dense or frame.sparse)]
    medians = sorted((median, name) for median, name in found if median is not None)
    if not medians:
        return ""
    middle = medians[len(medians) // 2][0]
    (least, best), (most, worst) = medians[0], medians[-1]
    return f"median |dz|/z {least:.2%} ({best}) to {most:.2%} ({worst}), {middle:.2%} in the median frame"


def _head(check: DepthCheck) -> list[str]:
    return [
        "pixels",
        "coverage, %",
        "median |dz|/z, %",
        "90th percentile, %",
        "within 5 %, %",
        "bias, %",
        f"median |dz|, {_short(check)}",
    ]


def _short(check: DepthCheck) -> str:
    return "mm" if check.truth.metric else "units"


def _cells(errors: Errors) -> list[str]:
    return [
        str(errors.pixels),
        _number(errors.coverage, 100.0),
        _number(errors.median, 100.0),
        _number(errors.p90, 100.0),
        _number(errors.within, 100.0),
        _number(errors.bias, 100.0, "+"),
        _number(errors.median_length),
    ]


def _number(value: float | None, factor: float = 1.0, sign: str = "") -> str:
    return _NONE if value is None else f"{value * factor:{sign}.3g}"
