"""HTML page of the comparison of depth: tables, the calibration of the confidence, and frames."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np

from coliags_plugin.checks.depth.check import DepthCheck
from coliags_plugin.checks.depth.error_maps import error_limit, error_map
from coliags_plugin.checks.depth.measures import Measures
from coliags_plugin.checks.depth.pairing import true_depth_at
from coliags_plugin.checks.depth.text import (
    calibration_line,
    confidence_table,
    error_table,
    fact_rows,
    frame_table,
    kinds,
)
from coliags_plugin.outputs.charts import Series, color_bar_svg, line_chart
from coliags_plugin.outputs.colormaps import colorize_depth, depth_limits
from coliags_plugin.outputs.image_files import encode_png
from coliags_plugin.outputs.page import fact_list, figure, table, write_page

#: Number of frames shown.
_SHOWN = 4


def write_depth_page(check: DepthCheck, output: Path) -> None:
    """Write the HTML page of a comparison.

    Raises:
        InputError: ``output`` is a folder, or cannot be written.
    """
    title = f"{check.estimate.path.name}: depth check"
    sections = [_measures(check, kind, measures) for kind, measures in kinds(check)]
    sections += [_frames(check), _every_frame(check)]
    header = f"<h1>{escape(title)}</h1>" + fact_list(dict(fact_rows(check)))
    write_page(output, title, header, sections)


def _measures(check: DepthCheck, kind: str, measures: Measures) -> str:
    parts = [f"<h2>Against {escape(kind)}</h2>", table(*error_table(check, measures))]
    confidence = confidence_table(measures)
    if confidence is not None:
        parts.append(f'<h3>Confidence</h3><p class="hint">{escape(calibration_line(measures))}</p>')
        parts.append(table(*confidence))
        bins = [found for found in measures.bins if found.high > 0.0]
        stated = [100.0 * found.stated for found in bins]
        series = [
            Series("observed", 0, stated, [100.0 * found.observed for found in bins]),
            Series("calibrated", 1, [0.0, 100.0], [0.0, 100.0]),
        ]
        legend = "".join(f'<li><i class="swatch s{line.style}"></i>{line.name}</li>' for line in series)
        chart = line_chart(series, "stated confidence, %", "within 5 %, % of the pixels", markers=True)
        parts.append(f'<div class="charts"><figure>{chart}<ul class="legend">{legend}</ul></figure></div>')
    return f"<section>{''.join(parts)}</section>"


def _every_frame(check: DepthCheck) -> str:
    return f"<section><h2>Every frame</h2>{table(*frame_table(check))}</section>"


def _frames(check: DepthCheck) -> str:
    if check.dense is None:
        return ""
    places = np.unique(np.linspace(0, len(check.pairs.places) - 1, _SHOWN).astype(int))
    limit, unit = error_limit(check), "mm" if check.truth.metric else "units"
    bar = color_bar_svg((0.0, limit), unit, "error", "|dz|", "depth-error")
    views = "".join("".join(_view(check, place, limit)) for place in places)
    note = "Errors are hatched where the truth is unknown, and grey where there is no estimate."
    return f'<section><h2>Frames</h2><p class="hint">{note}</p><div class="scales">{bar}</div>{views}</section>'


def _view(check: DepthCheck, place: int, limit: float) -> Iterator[str]:
    here, there = check.pairs.places[place]
    estimate, truth = check.estimate.read(here), check.truth.read(there)
    true, error = true_depth_at(estimate, truth), error_map(check, estimate, truth, limit)
    if true is None or error is None or estimate.depth is None:
        return
    limits = depth_limits([true])
    scaled = estimate.depth * (1.0 if check.scale is None else check.scale)
    cells = [] if estimate.image is None else [figure(encode_png(estimate.image), "image")]
    cells += [
        figure(encode_png(colorize_depth(true, limits)), f"true, 0 to {limits[1]:g}"),
        figure(encode_png(colorize_depth(scaled, limits)), "estimate, same colours"),
        figure(encode_png(error), "|dz|"),
    ]
    if estimate.confidence is not None:
        grey = np.repeat(np.rint(estimate.confidence * 255.0).astype(np.uint8)[..., None], 3, axis=2)
        cells.append(figure(encode_png(grey), "confidence, white 1"))
    yield f"<h3>{escape(check.estimate.names[here])}</h3>"
    yield f'<div class="view" style="--cells: {len(cells)}">{"".join(cells)}</div>'
