"""Numbers of a measurement of coverage as text and JSON values."""

from __future__ import annotations

from typing import Any

import numpy as np

from coliags_plugin.surface.coverage.evaluation import Evaluation
from coliags_plugin.surface.coverage.levels import Level
from coliags_plugin.surface.coverage.map import legend_entries
from coliags_plugin.surface.coverage.measure import Coverage

#: Said wherever a clinician could read the results.
RESEARCH_USE = "Research use only: not a medical device, and not for decisions about a patient."
#: Length of a segment in the table of segments, mm.
_SEGMENT = 20.0

Table = tuple[list[str], list[list[str]]]


def as_json(coverage: Coverage, evaluation: Evaluation | None) -> dict[str, Any]:
    """Everything that is measured, as JSON values."""
    total = coverage.area(np.ones(len(coverage.level), bool))
    seen = coverage.inside & coverage.views.seen
    return {
        "note": RESEARCH_USE,
        "unit": "mm",
        "settings": coverage.settings.model_dump(),
        "frames": len(coverage.names),
        "section": {
            "start": round(coverage.section.start, 3),
            "end": round(coverage.section.end, 3),
            "rule": "from the first to the last place along the lumen where half of the wall of 10 mm was seen",
        },
        "area": total,
        "shares": {level.name.lower(): coverage.area(coverage.level == level) / total for level in Level},
        "guessed_share": coverage.area(coverage.guessed) / total,
        "seen_surface": {
            "median_distance": _median(coverage, coverage.views.distance, seen),
            "median_incidence_degrees": _median(coverage, coverage.views.incidence, seen),
            "median_pixels_per_mm": _median(coverage, coverage.views.pixels_per_mm, seen),
            "median_frames": _median(coverage, coverage.views.frames.astype(np.float32), seen),
        },
        "regions": [
            {
                "number": number,
                "area": region.area,
                "diameter": region.diameter,
                "guessed_area": region.guessed_area,
                "along": region.arc,
                "clock_degrees": region.clock,
                "from": region.reach[0],
                "to": region.reach[1],
                "at_end_of_section": region.at_end,
                "centroid": [float(value) for value in region.centroid],
                "nearest_frame": coverage.names[region.nearest],
            }
            for number, region in enumerate(coverage.regions, start=1)
        ],
        "truth": None if evaluation is None else evaluation.as_json(),
    }


def level_table(coverage: Coverage) -> Table:
    """Area and share of each level."""
    total = coverage.area(np.ones(len(coverage.level), bool))
    rows = []
    for label, _, chosen in legend_entries(coverage):
        area = coverage.area(chosen)
        rows.append([label, f"{area / 100.0:.1f}", f"{100.0 * area / total:.1f}"])
    return ["wall", "area, cm²", "share, %"], rows


def segment_table(coverage: Coverage) -> Table:
    """Shares of each 20 mm of the section."""
    head = ["along, mm", "area, cm²", *(f"{level.label}, %" for level in reversed(Level))]
    rows = []
    areas, start = coverage.mesh.areas, coverage.section.start
    while start < coverage.section.end:
        end = min(start + _SEGMENT, coverage.section.end)
        here = (coverage.arc >= start) & (coverage.arc < end)
        total = float(areas[here].sum())
        if total:
            shares = [100.0 * float(areas[here & (coverage.level == level)].sum()) / total for level in reversed(Level)]
            rows.append([f"{start:.0f} to {end:.0f}", f"{total / 100.0:.1f}", *(f"{share:.0f}" for share in shares)])
        start = end
    return head, rows


def region_table(coverage: Coverage) -> Table:
    """The missed regions."""
    head = [
        "region",
        "area, mm²",
        "diameter, mm",
        "along, mm",
        "from, mm",
        "to, mm",
        "at an end",
        "clock",
        "place guessed, %",
        "x, y, z, mm",
        "nearest frame",
    ]
    rows = [
        [
            str(number),
            f"{region.area:.0f}",
            f"{region.diameter:.1f}",
            f"{region.arc:.0f}",
            f"{region.reach[0]:.0f}",
            f"{region.reach[1]:.0f}",
            "yes" if region.at_end else "",
            clock_text(region.clock),
            f"{100.0 * region.guessed_area / region.area:.0f}",
            ", ".join(f"{value:.1f}" for value in region.centroid),
            coverage.names[region.nearest],
        ]
        for number, region in enumerate(coverage.regions, start=1)
    ]
    return head, rows


def truth_table(evaluation: Evaluation) -> Table:
    """Scores beside those of the baselines."""
    head = [
        "",
        "face IoU",
        "region IoU",
        "recall",
        "false reassurance",
        "false alarm",
        "regions",
    ]
    kinds = {
        "measured wall": evaluation.surface,
        "measured distance along viewing rays": evaluation.rays,
        "all unseen": evaluation.all_unseen,
        "random cells of the same area": evaluation.random,
    }
    rows = [
        [
            name,
            *(
                "" if value is None else f"{value:.3f}"
                for value in (
                    scores.face_iou,
                    scores.region_iou,
                    scores.recall,
                    scores.false_reassurance,
                    scores.false_alarm,
                )
            ),
            f"{scores.predicted_regions} of {scores.true_regions}",
        ]
        for name, scores in kinds.items()
    ]
    return head, rows


def clock_text(degrees: float) -> str:
    """Clock angle as the hour on a dial: 0 degrees is 12 o'clock."""
    minutes = round(degrees / 360.0 * 720.0) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}"


def summary(coverage: Coverage, evaluation: Evaluation | None) -> list[str]:
    """A few lines for a terminal."""
    _, levels = level_table(coverage)
    missed = sum(region.area for region in coverage.regions)
    lines = [
        f"section of {coverage.section.length:.0f} mm, {len(coverage.names)} frames",
        *(f"{share:>5} %  {label} ({area} cm²)" for label, area, share in levels),
        f"{len(coverage.regions)} missed regions above {coverage.settings.region_diameter:g} mm, "
        f"{missed / 100.0:.1f} cm²",
    ]
    if evaluation is not None:
        scores = evaluation.surface
        named = {
            "face IoU": scores.face_iou,
            "region IoU": scores.region_iou,
            "recall": scores.recall,
            "false reassurance": scores.false_reassurance,
            "false alarm": scores.false_alarm,
        }
        told = ", ".join(f"{name} {value:.3f}" for name, value in named.items() if value is not None)
        lines.append(f"against the truth: {told}")
    return [*lines, RESEARCH_USE]


def _median(coverage: Coverage, values: np.ndarray, chosen: np.ndarray) -> float | None:
    """Median over surface, None where nothing was seen."""
    areas, found = coverage.mesh.areas[chosen], values[chosen]
    if not len(found):
        return None
    order = np.argsort(found)
    half = np.searchsorted(np.cumsum(areas[order]), 0.5 * areas.sum())
    return float(found[order][min(int(half), len(found) - 1)])
