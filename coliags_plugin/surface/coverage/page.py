"""HTML page of a measurement of coverage."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from coliags_plugin.outputs.image_files import encode_png
from coliags_plugin.outputs.page import fact_list, figure, record, table, write_page
from coliags_plugin.surface.coverage.evaluation import Evaluation
from coliags_plugin.surface.coverage.levels import Level
from coliags_plugin.surface.coverage.map import draw_map
from coliags_plugin.surface.coverage.measure import Coverage
from coliags_plugin.surface.coverage.pictures import region_picture
from coliags_plugin.surface.coverage.text import (
    RESEARCH_USE,
    clock_text,
    level_table,
    region_table,
    segment_table,
    truth_table,
)
from coliags_plugin.surface.coverage.views import CoverageView

#: Regions with a picture.
_PICTURED = 12

_STYLE = ".map img { width: 100%; height: auto; background: #fff; }"


def write_coverage_page(
    coverage: Coverage,
    views: Sequence[CoverageView],
    output: Path,
    name: str,
    evaluation: Evaluation | None = None,
) -> None:
    """Write the self-contained page.

    Args:
        coverage: The measurement.
        views: The frames that it was measured from, for pictures.
        output: The file.
        name: Of the scene or run, for the title.
        evaluation: Against the truth, where there is one.

    Raises:
        InputError: ``output`` is a folder, or cannot be written, or an image of a frame cannot be read.
    """
    title = f"{name}: coverage"
    everything = np.ones(len(coverage.level), bool)
    seen = 1.0 - coverage.area(coverage.level == Level.UNSEEN) / coverage.area(everything)
    missed = sum(region.area for region in coverage.regions)
    facts = {
        "seen": f"{100.0 * seen:.0f} % of the wall",
        "section": f"{coverage.section.length:.0f} mm of the lumen, {coverage.area(everything) / 100.0:.0f} cm²",
        "missed regions": f"{len(coverage.regions)}, {missed / 100.0:.1f} cm² together",
        "place guessed": f"{100.0 * coverage.area(coverage.guessed) / coverage.area(everything):.0f} % of the wall",
        "frames": str(len(coverage.names)),
    }
    header = f'<h1>{escape(title)}</h1><p class="note">{escape(RESEARCH_USE)}</p>{fact_list(facts)}'
    sections = [_map(coverage), _regions(coverage, views), _segments(coverage), _truth(evaluation), _how(coverage)]
    write_page(output, title, header, sections, style=_STYLE)


def _map(coverage: Coverage) -> str:
    note = (
        "The wall, cut open at 12 o'clock and laid flat: along the lumen from left to right, round the clock from top "
        "to bottom, as seen by a viewer who looks deeper into the lumen. Wall that turns away from the lumen, as the "
        "sides of folds, is narrower here than it is; areas in the tables are those of the surface. Numbers mark "
        "missed regions, lines the ends of the section."
    )
    image = figure(encode_png(draw_map(coverage)), "unrolled map")
    return (
        f'<section><h2>Map</h2><p class="hint">{escape(note)}</p><div class="map">{image}</div>'
        f"{table(*level_table(coverage))}</section>"
    )


def _regions(coverage: Coverage, views: Sequence[CoverageView]) -> str:
    limit = f"{coverage.settings.region_diameter:g} mm"
    if not coverage.regions:
        return f"<section><h2>Missed regions</h2><p>None is larger than a circle of {limit} diameter.</p></section>"
    cells = []
    for number, region in enumerate(coverage.regions[:_PICTURED], start=1):
        picture = region_picture(coverage, region, views[region.nearest])
        if picture is not None:
            place = f"{number}: {region.area:.0f} mm² at {region.arc:.0f} mm, {clock_text(region.clock)} o'clock"
            cells.append(figure(encode_png(picture), f"{place}, frame {coverage.names[region.nearest]}"))
    note = (
        f"Connected wall of the section that no frame shows, larger than a circle of {limit} diameter. Pictures are "
        "the nearest recorded frames that look where each region is; it is drawn where it lies, behind folds where it "
        "is hidden. Where the place of a region is guessed, so are its shape and area."
    )
    pictures = f'<div class="view" style="--cells: 3">{"".join(cells)}</div>' if cells else ""
    return (
        f'<section><h2>Missed regions</h2><p class="hint">{escape(note)}</p>{table(*region_table(coverage))}'
        f"{pictures}</section>"
    )


def _segments(coverage: Coverage) -> str:
    return f"<section><h2>Along the lumen</h2>{table(*segment_table(coverage))}</section>"


def _truth(evaluation: Evaluation | None) -> str:
    if evaluation is None:
        return ""
    note = (
        f"On the true surface, of which {100.0 * evaluation.unseen_share:.0f} % of the section is unseen. False "
        "reassurance: share of the unseen surface that is called seen. False alarm: share of the surface called "
        "unseen that was seen. Calling everything unseen finds every region, so that recall says nothing alone."
    )
    scores = table(*truth_table(evaluation))
    return f'<section><h2>Against the truth</h2><p class="hint">{escape(note)}</p>{scores}</section>'


def _how(coverage: Coverage) -> str:
    settings = coverage.settings
    note = (
        f"Seen: {settings.glance_frames} frames or more show the surface from at most {settings.far:g} mm, in pixels "
        f"of a grey value of {settings.dark:g} or more (of 1), at most {settings.grazing:g} degrees from its normal. "
        "At a glance: fewer frames do. Too dark or too far: frames show it, but none so near and bright. The section "
        "reaches from the first to the last place along the lumen where half of the wall (over 10 mm) was seen; "
        "beyond it, nothing is called missed. Where no wall was reconstructed, its place is guessed from the wall "
        "around it."
    )
    chosen = record("Settings", settings.model_dump())
    return f'<section><h2>How it is measured</h2><p class="hint">{escape(note)}</p>{chosen}</section>'
